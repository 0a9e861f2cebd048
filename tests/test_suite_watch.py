"""What ends a whole run of the fast tests."""

from unittest.mock import Mock

import suite_watch


def test_dear_tests_and_too_many_end_a_whole_run(monkeypatch):
    monkeypatch.setattr(suite_watch, "is_whole", lambda config: True)
    watch = suite_watch.SuiteWatch(Mock(spec=["getoption"]))
    watch.whole = lambda: 100.0
    watch.seconds = {"dear": 5.1} | dict.fromkeys(range(2400), 4.9)
    dear, many = watch.faults()
    assert dear.startswith("dear takes 5.1 CPU seconds")
    assert many.startswith("2401 items")
    del watch.seconds["dear"]
    assert watch.faults() == []

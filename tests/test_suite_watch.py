"""What ends a whole run of the fast tests."""

from suite_watch import faults


def test_dear_tests_and_too_many_end_a_whole_run():
    most = dict.fromkeys(range(2400), 4.9)
    assert faults(most, 100.0) == []
    dear, many = faults({"dear": 5.1} | most, 100.0)
    assert dear.startswith("dear takes 5.1 CPU seconds")
    assert many.startswith("2401 items")

"""What does not fit into memory is refused with numbers."""

import pytest

from qgs.machine import TooLargeError, refuse_more_than_memory, with_unit


def test_only_what_does_not_fit_is_refused(monkeypatch):
    monkeypatch.setattr("qgs.machine.available_bytes", lambda: 10)
    refuse_more_than_memory("this", {"a": 4, "b": 6}, "Less.")
    with pytest.raises(TooLargeError, match=r"11 bytes.*10 bytes.*b 7 bytes, a 4"):
        refuse_more_than_memory("this", {"a": 4, "b": 7}, "Less.")
    assert [with_unit(n) for n in (999, 1500, 2 * 10**30)] == ["999 bytes", "1.5 kB", "2e+15 PB"]

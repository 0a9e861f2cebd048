"""What does not fit into memory is refused with numbers."""

from tables import must_refuse

from qgs.machine import TooLargeError, refuse_more_than_memory


def test_only_what_does_not_fit_is_refused(monkeypatch):
    monkeypatch.setattr("qgs.machine.available_bytes", lambda: 10)
    refuse_more_than_memory("this", 10, "Less.")
    reason = r"11 bytes.*10 bytes.*Less"
    must_refuse(reason, refuse_more_than_memory, "this", 11, "Less.", kind=TooLargeError)

"""How a check ends: it passes, finds the contract broken, or cannot be made here."""

from __future__ import annotations


class ContractError(AssertionError):
    """A component does not keep its contract; `seen` says what it did instead."""

    def __init__(self, seen: str) -> None:
        super().__init__(seen)
        self.seen = seen


class CannotCheck(Exception):  # noqa: N818 (no error: the reason of a skip)
    """A check cannot be made in this place; the message is the reason."""


class ElsewhereError(RuntimeError):
    """An error of another process; the message says what was raised there, and where."""


def expect(holds: bool, seen: str) -> None:
    """Raise ContractError with what was `seen` unless the contract `holds`."""
    if not holds:
        raise ContractError(seen)

"""Small parts of messages."""

from __future__ import annotations


def a_type(value: object) -> str:
    """The type of `value` with its article, such as "an int"."""
    name = type(value).__name__
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"

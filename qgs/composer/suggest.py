"""Did you mean ...?"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def nearest(word: str, choices: Iterable[str]) -> str | None:
    """The choice that `word` is probably a misspelling of."""
    found = get_close_matches(word, sorted(choices), n=1, cutoff=0.6)
    return found[0] if found else None


def did_you_mean(word: str, choices: Iterable[str], noun: str) -> str:
    """A fix: the nearest choice, or all of them."""
    choices = sorted(choices)
    near = nearest(word, choices)
    if near is not None:
        return f"did you mean `{near}`?"
    return f"{noun}: {', '.join(choices)}" if choices else f"there are no {noun} here: remove it"

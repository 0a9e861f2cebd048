"""Functions that word parts of messages and tables."""

import logging
from collections.abc import Collection, Iterable
from difflib import get_close_matches
from functools import lru_cache

_log = logging.getLogger(__name__)


def listed(names: Iterable[object], most: int = 8, between: str = ", ") -> str:
    """Join the first `most` of `names` to one text; "and 3 more" counts the names left out.

    The text is "" without names. Long names are cut; names with unprintable characters are escaped.
    """
    shown = [*map(str, names)]
    more = f" and {len(shown) - most} more" if len(shown) > most else ""
    return between.join(name_shown(name) for name in shown[:most]) + more


def numbered(frame: int, name: str) -> str:
    """Return a frame's number and name, such as "3 (images/0004.png)", or "3" without a name."""
    return f"{frame} ({name})" if name not in ("", str(frame)) else str(frame)


def counted(number: int, what: str) -> str:
    """Return a number with the noun `what`, such as "1 thread" or "12 threads"."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def name_shown(name: str, most: int = 500) -> str:
    """Return `name` for a message: escaped if unprintable, cut after `most` characters."""
    name = name if name.replace("\n", "").isprintable() else repr(name)
    return name if len(name) <= most else f"{name[:most]} ... ({len(name):,} characters)"


def one_line(error: Exception) -> str:
    """Return an exception's message as one line.

    The exception's type is added, except for ValueError and FileNotFoundError, whose messages are
    written for users.
    """
    message = " ".join(str(error).split())
    if isinstance(error, ValueError | FileNotFoundError) and message:
        return message
    return f"{type(error).__name__}: {message}" if message else type(error).__name__


@lru_cache(maxsize=4096)
def warn_once(message: str) -> None:
    """Log the warning `message`, unless this process has logged it before."""
    _log.warning("%s", message)


def nearest(word: str, choices: Iterable[str]) -> str | None:
    """Return the choice that `word` probably misspells; None if no choice is similar."""
    # Names of one plug-in share their first part: at 0.6 any is like any other.
    return next(iter(get_close_matches(word, sorted(choices), cutoff=0.65)), None)


def did_you_mean(word: str, choices: Collection[str], noun: str) -> str:
    """Return advice for a message: the choice most similar to `word`, or else the list of choices.

    noun: what the choices are, such as "components"; it starts the list.
    """
    near = nearest(word, choices)
    return f"did you mean `{near}`?" if near else f"{noun}: {listed(sorted(choices), 30) or 'none'}"

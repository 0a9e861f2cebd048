"""Objects that installed distributions offer under an entry point group, found by metadata."""

import os
import sys
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar

T = TypeVar("T")


class ExtensionError(ValueError):
    """An entry point that cannot be loaded; the message names its distribution."""


def installed(group: str) -> tuple[EntryPoint, ...]:
    """Entry points of `group`. Imports nothing; sees what was installed since the last call."""
    # Reading all metadata takes some 10 ms, so that it is repeated only after a change of sys.path.
    return _read(group, tuple((path, _changed_at(path)) for path in sys.path))


def load(entry: EntryPoint, base: type[T]) -> type[T]:
    """The class that `entry` names, a subclass of `base`. Raises ExtensionError."""
    of = f" of {entry.dist.name} {entry.dist.version}" if entry.dist else ""
    where = f"{entry.group} {entry.name!r}{of} ({entry.value})"
    try:
        offered = entry.load()
    except Exception as error:  # importing runs the distribution's code
        reason = f"{type(error).__name__}: {error}"
        raise ExtensionError(f"{where} cannot be imported ({reason}): update it") from error
    if not (isinstance(offered, type) and issubclass(offered, base)):
        raise ExtensionError(f"{where} is no subclass of {base.__name__}: update it")
    return offered


@lru_cache(maxsize=16)
def _read(group: str, searched: tuple[tuple[str, int], ...]) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=group))


def _changed_at(path: str) -> int:
    try:
        return os.stat(path or ".").st_mtime_ns
    except OSError:
        return 0

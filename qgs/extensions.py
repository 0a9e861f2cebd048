"""Loading of plug-ins through entry points, which the metadata of installed distributions lists."""

import os
import sys
from functools import lru_cache
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from typing import Any, TypeVar

T = TypeVar("T")

INSTALL_ALL = 'run `pip install "query-gaussians[all]"`, which has all plug-ins of this project'
"""Advice in messages about a missing plug-in."""


class ExtensionError(ValueError):
    """Error for an entry point that cannot be loaded; the message names its distribution."""


def installed(group: str) -> EntryPoints:
    """Return the entry points of `group`, including distributions installed since the last call.

    This imports no distribution.
    """
    # Reading all metadata takes some 10 ms, so that it is repeated only after a change of sys.path.
    searched = [path for path in sys.path if os.path.exists(path)]
    return _read(group, *searched, *map(os.path.getmtime, searched))


def load(entry: EntryPoint, base: type[T]) -> type[T]:
    """Load the class that `entry` names; raise ExtensionError unless it is a subclass of `base`."""
    offered = imported(entry)
    if not (isinstance(offered, type) and issubclass(offered, base)):
        raise ExtensionError(
            f"{_where(entry)} is not a subclass of {base.__name__}: update the distribution"
        )
    return offered


def imported(entry: EntryPoint) -> Any:
    """Import the object that `entry` names; errors become ExtensionError with the distribution."""
    try:
        return entry.load()
    except Exception as error:
        # Importing runs the distribution's code.
        reason = f"{type(error).__name__}: {error}"
        raise ExtensionError(
            f"{_where(entry)} cannot be imported ({reason}): update the distribution"
        ) from error


def release_of(entry: EntryPoint) -> str:
    """Return the name and version of the distribution that offers an entry point."""
    assert entry.dist is not None
    return f"{entry.dist.name} {entry.dist.version}"


def _where(entry: EntryPoint) -> str:
    return f"{entry.group} {entry.name!r} of {release_of(entry)} ({entry.value})"


@lru_cache(maxsize=16)
def _read(group: str, *searched: str | float) -> EntryPoints:
    return entry_points(group=group)

"""A recipe as mappings and lists that know where each key and item was written."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

KeyPath: TypeAlias = tuple[str, ...]


@dataclass(frozen=True)
class Origin:
    """Where something was written; line 0 where lines mean nothing."""

    file: str
    line: int = 0

    def __str__(self) -> str:
        return f"{self.file}:{self.line}" if self.line else self.file


class MapNode(dict[str, Any]):
    """A mapping. origin: where it begins. origins: where each key was written."""

    def __init__(self, origin: Origin, items: Iterable[tuple[str, Any, Origin]] = ()) -> None:
        super().__init__()
        self.origin = origin
        self.origins: dict[str, Origin] = {}
        for key, value, place in items:
            self[key], self.origins[key] = value, place

    def entries(self) -> list[tuple[str, Any, Origin]]:
        """Keys and values, and where each key was written."""
        return [(key, value, self.origins[key]) for key, value in self.items()]

    def without(self, *names: str) -> "MapNode":
        """A copy that lacks `names`."""
        return MapNode(self.origin, (entry for entry in self.entries() if entry[0] not in names))

    def child(self, *path: str) -> "MapNode":
        """The mapping at `path`, an empty one where there is none."""
        found = self
        for key in path:
            value = found.get(key)
            empty = MapNode(found.origins.get(key, found.origin))
            found = value if isinstance(value, MapNode) else empty
        return found


class ListNode(list[Any]):
    """A list. origin: where it begins. origins: where each item was written."""

    def __init__(self, origin: Origin, items: Iterable[tuple[Any, Origin]] = ()) -> None:
        items = list(items)
        super().__init__(value for value, _ in items)
        self.origin, self.origins = origin, [place for _, place in items]


Node: TypeAlias = MapNode | ListNode | str | int | float | None


def from_plain(value: Any, origin: Origin) -> Node:
    """A tree of a plain Python value; raises ValueError for one that YAML could not hold."""
    if isinstance(value, Mapping):
        entries = ((str(key), from_plain(item, origin), origin) for key, item in value.items())
        return MapNode(origin, entries)
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return ListNode(origin, ((from_plain(item, origin), origin) for item in value))
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise ValueError(
        f"a recipe holds mappings, lists, strings, numbers, truth values and None; got {value!r} "
        f"({type(value).__name__})"
    )


def kind_of(value: Any) -> str:
    """What the value of a node is, for messages."""
    if isinstance(value, dict | list):
        return "a mapping" if isinstance(value, dict) else "a list"
    if value is None:
        return "nothing (null)"
    if isinstance(value, bool):
        return f"the truth value {str(value).lower()}"
    return f"the {'string' if isinstance(value, str) else 'number'} {value!r}"


def find(tree: MapNode, path: Sequence[str | int]) -> tuple[list[str | int], Origin, Node]:
    """Follow `path` into `tree`, skipping steps that are not written there.

    Returns the steps taken, where the last one was written, and the value found.
    """
    taken, origin, node = list[str | int](), tree.origin, cast("Any", tree)
    for step in path:
        if isinstance(node, MapNode) and str(step) in node:
            origin, node = node.origins[str(step)], node[str(step)]
        elif isinstance(node, ListNode) and isinstance(step, int) and step < len(node):
            origin, node = node.origins[step], node[step]
        else:
            continue
        taken.append(step)
    return taken, origin, node

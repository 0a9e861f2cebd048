"""A recipe as a tree in which every value and every key knows where it was written."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias, final

KeyPath: TypeAlias = tuple[str, ...]


@dataclass(frozen=True)
class Origin:
    """Where something was written; line 0 where lines mean nothing."""

    file: str
    line: int = 0

    def __str__(self) -> str:
        return f"{self.file}:{self.line}" if self.line else self.file


@final
@dataclass(frozen=True)
class ScalarNode:
    """A string, number, bool or None."""

    origin: Origin
    value: Any


@final
@dataclass(frozen=True)
class ListNode:
    """A list."""

    origin: Origin
    items: tuple[Node, ...] = ()


@final
@dataclass(frozen=True)
class MapNode:
    """A mapping. keys: where each key was written."""

    origin: Origin
    items: Mapping[str, Node] = field(default_factory=dict)
    keys: Mapping[str, Origin] = field(default_factory=dict)

    def with_item(self, key: str, node: Node, origin: Origin) -> MapNode:
        """A copy in which `key` is `node`."""
        return MapNode(self.origin, {**self.items, key: node}, {**self.keys, key: origin})

    def without(self, *names: str) -> MapNode:
        """A copy that lacks `names`."""
        return MapNode(
            self.origin,
            {key: node for key, node in self.items.items() if key not in names},
            {key: origin for key, origin in self.keys.items() if key not in names},
        )

    def child_map(self, key: str) -> MapNode:
        """The mapping under `key`, an empty one where there is none."""
        node = self.items.get(key)
        return node if isinstance(node, MapNode) else MapNode(self.keys.get(key, self.origin))


Node: TypeAlias = ScalarNode | ListNode | MapNode


def from_plain(value: Any, origin: Origin) -> Node:
    """A tree of a plain Python value, all of one origin.

    Raises ValueError for a value that YAML could not hold.
    """
    if isinstance(value, Mapping):
        items = {str(key): from_plain(item, origin) for key, item in value.items()}
        return MapNode(origin, items, dict.fromkeys(items, origin))
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return ListNode(origin, tuple(from_plain(item, origin) for item in value))
    if isinstance(value, os.PathLike):
        return ScalarNode(origin, os.fspath(value))
    if value is None or isinstance(value, str | bool | int | float):
        return ScalarNode(origin, value)
    raise ValueError(
        f"a recipe holds mappings, lists, strings, numbers, truth values and None; got {value!r} "
        f"({type(value).__name__})"
    )


def to_plain(node: Node) -> Any:
    """The plain value of a tree."""
    if isinstance(node, MapNode):
        return {key: to_plain(item) for key, item in node.items.items()}
    if isinstance(node, ListNode):
        return [to_plain(item) for item in node.items]
    return node.value


def kind_of(node: Node) -> str:
    """What `node` is, for messages."""
    if isinstance(node, MapNode):
        return "a mapping"
    if isinstance(node, ListNode):
        return "a list"
    if node.value is None:
        return "nothing (null)"
    if isinstance(node.value, bool):
        return f"the truth value {str(node.value).lower()}"
    if isinstance(node.value, str):
        return f"the string {node.value!r}"
    return f"the number {node.value!r}"


def is_null(node: Node | None) -> bool:
    """Whether `node` is absent or null."""
    return node is None or (isinstance(node, ScalarNode) and node.value is None)


def locate(node: Node, path: Sequence[str | int]) -> Origin:
    """Where the value at `path` was written; its nearest written ancestor if it was not."""
    origin = node.origin
    for step in path:
        if isinstance(node, MapNode) and str(step) in node.items:
            origin, node = node.keys[str(step)], node.items[str(step)]
        elif isinstance(node, ListNode) and isinstance(step, int) and step < len(node.items):
            node = node.items[step]
            origin = node.origin
    return origin

"""A recipe as mappings and lists that know where each key and item was written."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias, cast

KeyPath: TypeAlias = tuple[str, ...]

MAX_NESTING = 64
MAX_VALUES = 20_000
LARGEST = 2**63 - 1
"""Integers beyond +- this are refused: pydantic and JSON readers elsewhere would fail on them."""


class RecipeSizeError(ValueError):
    """A recipe with more in it, or deeper in each other, than any recipe needs."""

    fix = "write the recipe flatter and shorter, with fewer aliases"


class UnfitValueError(ValueError):
    """A value that no recipe holds. path: where it stands. fix: what to do."""

    def __init__(self, path: KeyPath, reason: str, fix: str) -> None:
        super().__init__(reason)
        self.path, self.fix = path, fix


@dataclass
class Count:
    """Counts the values and keys of a recipe over all its files, those of aliases each time."""

    values: int = field(default=0, init=False)

    def one(self, depth: int) -> None:
        """Count a value that stands inside `depth` others; raises RecipeSizeError."""
        self.values += 1
        if self.values > MAX_VALUES:
            raise RecipeSizeError(
                f"there are more than {MAX_VALUES:,} values and keys, those of aliases counted "
                "each time"
            )
        if depth > MAX_NESTING:
            raise RecipeSizeError(
                f"mappings and lists stand more than {MAX_NESTING} deep in each other"
            )


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


def from_plain(value: Any, origin: Origin, count: Count, path: KeyPath = ()) -> Node:
    """A tree of a plain Python value, which stands at `path`.

    Raises UnfitValueError for a value that YAML could not hold, RecipeSizeError.
    """
    count.one(len(path))
    if isinstance(value, Mapping):
        keys = [(_checked(str(key), path), item) for key, item in value.items()]
        for _ in keys:  # as the scanner of YAML counts
            count.one(len(path))
        entries = ((k, from_plain(item, origin, count, (*path, k)), origin) for k, item in keys)
        return MapNode(origin, entries)
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        items = (from_plain(x, origin, count, (*path, str(i))) for i, x in enumerate(value))
        return ListNode(origin, ((item, origin) for item in items))
    value = os.fspath(value) if isinstance(value, os.PathLike) else value
    if value is None or isinstance(value, str | bool | int | float):
        return _checked(value, path)
    kind = type(value).__name__
    reason = f"a recipe holds no {kind}, got {value!r}"
    raise UnfitValueError(path, reason, "give mappings, lists, strings, numbers, bools, None")


def _checked(value: Any, path: KeyPath) -> Any:
    """`value`, a scalar or a key at `path`; raises UnfitValueError."""
    if isinstance(value, str):
        fault = text_fault(value)
        if fault:
            raise UnfitValueError(path, f"{shortened(repr(value))} {fault}", "remove it")
    elif isinstance(value, int) and abs(value) > LARGEST:
        raise UnfitValueError(path, "an integer does not fit into 64 bits", "give a smaller one")
    return value


def text_fault(text: str) -> str:
    """What neither a path nor a text in UTF-8 can hold, of all that a string can; "" if nothing."""
    if "\0" in text:
        return "holds a NUL character"
    lone = any("\ud800" <= character <= "\udfff" for character in text)
    return "holds half of a surrogate pair, which is no character" if lone else ""


def shortened(text: str, most: int = 120) -> str:
    """`text` for a message: its middle left out beyond `most` characters, no control characters."""
    if len(text) > most:
        half = most // 2
        text = f"{text[:half]} ... {text[-half:]} ({len(text):,} characters)"
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


def kind_of(value: Any) -> str:
    """What the value of a node is, for messages."""
    if isinstance(value, dict | list):
        return "a mapping" if isinstance(value, dict) else "a list"
    if value is None:
        return "nothing (null)"
    if isinstance(value, bool):
        return f"the truth value {str(value).lower()}"
    return f"the {'string' if isinstance(value, str) else 'number'} {shortened(repr(value))}"


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

"""YAML 1.2 text of recipes, and its values as nodes, which know the line of each key."""

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from itertools import count
from typing import Any

import yaml

from qgs.recipe.errors import Origin, Problems

KeyPath = tuple[str, ...]

# A few lines of aliases can expand to billions of nodes, so limits count expanded nodes.
MAX_DEPTH = 64
MAX_NODES = 20_000

_STANDARD = "tag:yaml.org,2002:"
# YAML 1.1, which PyYAML reads, takes `off` for false, 1_000 and 1:30 for numbers, 017 for 15.
_SCALARS = {
    "null": r"~|null|Null|NULL|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+",
    "float": r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"
    r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
}
"""Regular expression for unquoted YAML 1.2 scalars of each kind; all other scalars are strings."""
_RESOLVERS: dict[str | None, list[tuple[str, re.Pattern[str]]]] = {
    None: [(_STANDARD + kind, re.compile(rf"({text})\Z")) for kind, text in _SCALARS.items()]
}
_TAGS = {_STANDARD + kind for kind in (*_SCALARS, "str", "map", "seq")}


class MapNode(dict[str, Any]):
    """A mapping that knows in which file and line it was written.

    origin: file and line of its start. origins: file and line of each key.
    under, over: the two mappings that were merged into this one, if any. Values of `over` won.
    """

    under: "MapNode | None" = None
    over: "MapNode"

    def __init__(self, origin: Origin, items: Iterable[tuple[str, Any, Origin]] = ()) -> None:
        super().__init__()
        self.origin = origin
        self.origins: dict[str, Origin] = {}
        for key, value, written in items:
            self.put(key, value, written)

    def put(self, key: str, value: Any, origin: Origin) -> None:
        """Set `key` to `value`; `origin` is the file and line of the key."""
        self[key] = value
        self.origins[key] = origin

    def entries(self) -> list[tuple[str, Any, Origin]]:
        """Return key, value and origin (file and line) of each entry."""
        return [(key, value, self.origins[key]) for key, value in self.items()]

    def without(self, *names: str) -> "MapNode":
        """Return a copy without the keys `names`."""
        return MapNode(self.origin, (entry for entry in self.entries() if entry[0] not in names))

    def child(self, *path: str) -> "MapNode":
        """Return the mapping at `path`; an empty mapping if `path` leads to no mapping."""
        found = self
        for key in path:
            empty = MapNode(found.origin_of(key))
            value = found.get(key)
            found = value if isinstance(value, MapNode) else empty
        return found

    def origin_of(self, key: str) -> Origin:
        """Return file and line of `key`; if the mapping lacks this key, those of the mapping."""
        return self.origins.get(key, self.origin)


class ListNode(list[Any]):
    """A list that knows where its items were written.

    origins: file and line of each item, by index.
    """

    def __init__(self, items: Iterable[tuple[Any, Origin]]) -> None:
        entries = [*items]
        super().__init__(value for value, _ in entries)
        self.origins = dict(enumerate(origin for _, origin in entries))


Node = MapNode | ListNode | str | int | float | None


def items_of(value: Any, origin: Origin) -> list[tuple[Any, Origin]]:
    """Return the items of `value`, with file and line of each item.

    A single value, written at `origin`, counts as a list of one item; null counts as an empty list.
    """
    if isinstance(value, ListNode):
        return [*zip(value, value.origins.values(), strict=True)]
    return [] if value is None else [(value, origin)]


def from_plain(value: Mapping[str, Any], origin: Origin) -> MapNode:
    """Convert a plain Python mapping to nodes, all with the file and line `origin`.

    Raises ValueError or TypeError for values that YAML cannot hold.
    """

    def read(plain: Any) -> Any:
        if isinstance(plain, dict):
            return MapNode(origin, ((key, read(item), origin) for key, item in plain.items()))
        if isinstance(plain, list):
            return ListNode((read(item), origin) for item in plain)
        return plain

    # JSON refuses cyclic values, and values that are not plain.
    return read(json.loads(json.dumps(value, default=os.fspath)))


def find(tree: MapNode, path: Sequence[str | int]) -> tuple[list[str | int], Origin, Node]:
    """Follow `path` into `tree`, skipping keys that are missing on the way.

    Returns the keys that were found, the file and line of the last one, and the value there.
    """
    taken = list[str | int]()
    origin = tree.origin
    node: Any = tree
    for step in path:
        # Pydantic names the tag of a union as a step, which nobody writes.
        key: Any = str(step) if isinstance(node, MapNode) else step
        origins = getattr(node, "origins", {})
        if key in origins:
            origin = origins[key]
            node = node[key]
            taken.append(step)
    return taken, origin, node


def brief(value: Any) -> str:
    """Return the value of a node as text for messages: JSON of at most 200 characters."""
    return f"`{json.dumps(value):.200}`"


class Yaml12Loader(yaml.SafeLoader):
    """YAML loader that types unquoted values by the rules of YAML 1.2; `_scalar` converts them."""

    yaml_implicit_resolvers = _RESOLVERS


class Yaml12Dumper(yaml.SafeDumper):
    """YAML dumper that quotes exactly the strings that Yaml12Loader would not read as strings."""

    yaml_implicit_resolvers = _RESOLVERS

    # Anchors would be hard to read in a resolved recipe.
    def ignore_aliases(self, data: Any) -> bool:
        """Return True, so that a repeated value is written in full each time."""
        return True


def dump(value: Any, *, flow: bool | None = False) -> str:
    """Write `value` as YAML 1.2, without sorting keys."""
    # A width that long breaks no line: each option of a recipe stays on its own.
    style: Any = {"default_flow_style": flow, "sort_keys": False, "width": 10_000}
    return yaml.dump(value, Dumper=Yaml12Dumper, **style)


def inline(value: Any) -> str:
    """Write `value` as YAML 1.2 on one line."""
    return dump(value, flow=True).removesuffix("\n").removesuffix("\n...")


def load_mapping(text: str, file: str, problems: Problems) -> MapNode:
    """Read YAML `text` of `file`; raise RecipeError if it is invalid or not a mapping."""
    node = load_text(text, file, problems)
    if isinstance(node, MapNode):
        return node
    fix = "write `key: value` lines, starting with `recipe: 1`"
    problems.stop(Origin(file, 1), "", f"a recipe must be a mapping, got {brief(node)}", fix)


def load_text(
    text: str, file: str, problems: Problems, line: int | None = None, path: KeyPath = ()
) -> Node:
    """Read YAML `text` of `file`; raise RecipeError if it is invalid.

    line: line number to store for all nodes; None stores the line of each node in `text`.
    path: path of the value in the recipe, for messages.
    """

    def origin(mark: yaml.Mark | None) -> Origin:
        found = mark.line + 1 if mark else 1
        return Origin(file, found if line is None else line)

    try:
        root = _composed(text)
        return None if root is None else _read(root, origin, count(1))
    # Python's stack may overflow while PyYAML composes, before `_read` counts levels.
    except (yaml.YAMLError, RecursionError) as error:
        reason = f"this is not valid YAML of a recipe: {getattr(error, 'problem', error)}"
        fix = "correct the line; check indentation (spaces, no tabs), brackets, quotes and `: `"
        problems.stop(origin(getattr(error, "problem_mark", None)), path, reason, fix)


# The variants of a study extend the same files over and over.
_composed = lru_cache(maxsize=128)(partial(yaml.compose, Loader=Yaml12Loader))


def _read(
    node: yaml.Node, origin: Callable[[yaml.Mark], Origin], counter: Iterator[int], depth: int = 0
) -> Node:
    """Convert PyYAML's node to a Node; raise YAMLError for values that a recipe must not hold."""
    if depth > MAX_DEPTH or next(counter) > MAX_NODES:
        what = f"more than {MAX_DEPTH} levels or {MAX_NODES:,} values after expanding aliases"
        raise _fault(what, node)
    if node.tag not in _TAGS:
        raise _fault(f"the tag {node.tag!r} is not allowed in a recipe", node)
    below = partial(_read, origin=origin, counter=counter, depth=depth + 1)
    if isinstance(node, yaml.MappingNode):
        read = MapNode(origin(node.start_mark))
        for key_node, value_node in node.value:
            key = key_node.value
            # The last of two equal keys would win in silence.
            if not isinstance(key_node, yaml.ScalarNode) or key in read:
                raise _fault(f"the key {key!r:.100} appears twice, or is not text", key_node)
            read.put(key, below(value_node), origin(key_node.start_mark))
        return read
    if isinstance(node, yaml.SequenceNode):
        return ListNode((below(item), origin(item.start_mark)) for item in node.value)
    kind = node.tag.removeprefix(_STANDARD)
    try:
        return _scalar(kind, node.value)
    except ValueError:
        raise _fault(f"{node.value!r:.100} is not a valid {kind} of 64 bits", node) from None


def _fault(reason: str, node: yaml.Node) -> yaml.YAMLError:
    return yaml.MarkedYAMLError(problem=reason, problem_mark=node.start_mark)


def _scalar(kind: str, text: str) -> Any:
    """Convert `text` to the type `kind`, such as "int"; raise ValueError if this is impossible."""
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() == "true"
    if kind == "int":
        value = int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))
        # Seeds and sizes go to torch, which holds 64 bits.
        if abs(value) >= 2**63:
            raise ValueError
        return value
    if kind == "float":
        return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    return text

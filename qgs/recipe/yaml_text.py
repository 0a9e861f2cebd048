"""Recipes as YAML 1.2 text, and as nodes that know the line where each key was written."""

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, TypeAlias, cast

import yaml

from qgs.recipe.errors import Origin, Problems

KeyPath: TypeAlias = tuple[str, ...]

MAX_DEPTH, MAX_NODES = 64, 20_000
"""Limits of a tree, aliases written out: a few lines of aliases can stand for billions of nodes."""

_STANDARD = "tag:yaml.org,2002:"
_TAGS = {_STANDARD + name for name in ("null", "bool", "int", "float", "str", "map", "seq")}
_RESOLVERS = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", "-+.0123456789"),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", "-+."),
)


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


def from_plain(value: Any, origin: Origin, path: KeyPath = ()) -> Node:
    """A tree of a plain Python value, which stands at `path`.

    Raises ValueError for a value that YAML could not hold, and for one that contains itself.
    """
    if len(path) > MAX_DEPTH:
        raise ValueError(f"more than {MAX_DEPTH} levels, or a value that contains itself")
    if isinstance(value, Mapping):
        entries = ((str(k), from_plain(x, origin, (*path, str(k)))) for k, x in value.items())
        return MapNode(origin, ((key, item, origin) for key, item in entries))
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        items = (from_plain(x, origin, (*path, str(i))) for i, x in enumerate(value))
        return ListNode(origin, ((item, origin) for item in items))
    value = os.fspath(value) if isinstance(value, os.PathLike) else value
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise ValueError(f"`{'.'.join(path)}` is a {type(value).__name__}, which no recipe holds")


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


def kind_of(value: Any) -> str:
    """The kind of a node's value, for messages."""
    if isinstance(value, dict | list):
        return "a mapping" if isinstance(value, dict) else "a list"
    if value is None:
        return "nothing (null)"
    if isinstance(value, bool):
        return f"the truth value {str(value).lower()}"
    return f"the {'string' if isinstance(value, str) else 'number'} {value!r:.200}"


class Yaml12Loader(yaml.SafeLoader):
    """Composes nodes with YAML 1.2 tags; `_scalar_value` reads their values."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012


class Yaml12Dumper(yaml.SafeDumper):
    """Quotes exactly the strings that Yaml12Loader would not read as strings."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        """Write repeated values out."""
        return True


for _kind, _pattern, _first in _RESOLVERS:
    for _class in (Yaml12Loader, Yaml12Dumper):
        _full = re.compile(f"^(?:{_pattern})$")
        _class.add_implicit_resolver(_STANDARD + _kind, _full, list(_first))


def dump(value: Any, *, flow: bool | None = False) -> str:
    """`value` as YAML 1.2, keys in their order."""
    style: Any = {"default_flow_style": flow, "sort_keys": False, "width": 10_000}
    return yaml.dump(value, Dumper=Yaml12Dumper, **style)


def inline(value: Any) -> str:
    """`value` as YAML 1.2 on one line."""
    return dump(value, flow=True).removesuffix("\n").removesuffix("\n...")


def load_mapping(text: str, file: str, problems: Problems) -> MapNode:
    """The mapping in `text`; an empty one, and a problem, where there is something else."""
    node = load_text(text, file, problems)
    if isinstance(node, MapNode):
        return node
    origin = node.origin if isinstance(node, ListNode) else Origin(file, 1)
    if node is None:
        problems.stop(origin, "", "the file is empty", "write a recipe, at least `recipe: 1`")
    else:
        fix = "write `key: value` lines, the first of them `recipe: 1`"
        problems.stop(origin, "", f"a recipe is a mapping, this is {kind_of(node)}", fix)
    return MapNode(origin)


def load_text(
    text: str, file: str, problems: Problems, line: int | None = None, path: KeyPath = ()
) -> Node:
    """The value of `text`; an empty mapping, and a problem, where it is no YAML.

    line: given to every node in place of its own line. path: where the text belongs.
    """
    number = 1
    try:
        root = _composed(text)
        return None if root is None else _Reader(file, problems, line).read(root, path)
    except yaml.reader.ReaderError as error:
        number += text.count("\n", 0, error.position)
        reason, fix = f"the character {chr(error.character)!r} is not allowed in YAML", "remove it"
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        number += mark.line if mark else 0
        written = "".join(text.splitlines()[number - 1 : number])
        if "\t" in written[: len(written) - len(written.lstrip())] or "'\\t'" in str(error):
            reason, fix = "a tab stands where YAML wants spaces", "indent with spaces"
        else:
            reason = f"this is no valid YAML: {error.problem}"
            fix = "correct the line; check indentation, brackets, quotes and `: ` before it"
    except RecursionError:  # raised while PyYAML composes, before the reader counts levels
        reason, fix = "mappings or lists are nested too deep", "write the recipe flatter"
    problems.stop(Origin(file, number if line is None else line), ".".join(path), reason, fix)
    return MapNode(Origin(file, number))


_composed = lru_cache(maxsize=128)(partial(yaml.compose, Loader=Yaml12Loader))  # parses bases once


class _Reader:
    """Turns PyYAML's nodes into ours. line: see `load_text`."""

    def __init__(self, file: str, problems: Problems, line: int | None) -> None:
        self.file, self.problems, self.line, self.count = file, problems, line, 0

    def origin(self, node: yaml.Node) -> Origin:
        return Origin(self.file, node.start_mark.line + 1 if self.line is None else self.line)

    def read(self, node: yaml.Node, path: KeyPath) -> Node:
        self.count += 1
        if len(path) > MAX_DEPTH or self.count > MAX_NODES:
            what = f"more than {MAX_DEPTH} levels or {MAX_NODES:,} values, aliases written out"
            raise yaml.MarkedYAMLError(problem=what, problem_mark=node.start_mark)
        if node.tag not in _TAGS:
            reason = f"the tag {node.tag!r} is not allowed in a recipe"
            fix = "remove the tag; components are named with `type`"
            return self.problems.stop(self.origin(node), ".".join(path), reason, fix)
        if isinstance(node, yaml.MappingNode):
            return self.read_mapping(node, path)
        if isinstance(node, yaml.SequenceNode):
            items = enumerate(node.value)
            read = ((self.read(x, (*path, str(i))), self.origin(x)) for i, x in items)
            return ListNode(self.origin(node), read)
        try:
            return _scalar_value(node.tag, node.value)
        except ValueError:
            reason = f"{node.value!r:.100} is no {node.tag.removeprefix(_STANDARD)} of 64 bits"
            return self.problems.stop(self.origin(node), ".".join(path), reason, "correct it")

    def read_mapping(self, node: yaml.MappingNode, path: KeyPath) -> MapNode:
        read: dict[str, tuple[str, Node, Origin]] = {}
        for key_node, value_node in node.value:
            key, origin, reason = key_node.value, self.origin(key_node), ""
            if not isinstance(key_node, yaml.ScalarNode):
                key, reason, fix = "", "a key is a mapping or a list", "use a plain word as the key"
            elif key == "<<" and key_node.style is None:
                reason = "merge keys (`<<`) are not part of YAML 1.2"
                fix = "write the keys out, or share them between files with `extends`"
            elif key in read:
                reason = f"the key `{key}` is already given at {read[key][2]}"
                fix = "keep one of the two"
            if reason:
                place = ".".join((*path, key)).removesuffix(".")
                self.problems.add(origin, place, reason, fix)
            else:
                read[key] = (key, self.read(value_node, (*path, key)), origin)
        return MapNode(self.origin(node), read.values())


def _scalar_value(tag: str, text: str) -> Any:
    """The value of a scalar of a resolved `tag`; raises ValueError for a text that has none."""
    kind = tag.removeprefix(_STANDARD)
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() == "true"
    if kind == "int":
        value = int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))
        if abs(value) >= 2**63:  # torch could not hold it
            raise ValueError
        return value
    if kind == "float":
        return float(re.sub(r"\.(inf|nan)$", r"\1", text, flags=re.IGNORECASE))
    return text

"""YAML text to nodes: YAML 1.2 core scalars, each node with its line."""

from __future__ import annotations

import re
from typing import Any

import yaml

from qgs.composer.errors import Problems
from qgs.composer.nodes import (
    KeyPath,
    ListNode,
    MapNode,
    Node,
    Origin,
    ScalarNode,
    is_null,
    kind_of,
)

_RESOLVERS = (
    ("null", r"~|null|Null|NULL|", "~nN\0"),
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"
        r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
)


MAX_NESTING = 64
_LARGEST = 2**63 - 1


class NestingError(yaml.MarkedYAMLError):
    """Mappings and lists inside each other, beyond what any recipe needs."""


class Yaml12Loader(yaml.SafeLoader):
    """Composes nodes with YAML 1.2 tags; `qgs.composer.yaml_text` reads their values."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012
    _nesting = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """PyYAML's, refusing what would overflow the stack of whoever walks the tree."""
        self._nesting += 1
        if self._nesting > MAX_NESTING:
            raise NestingError(
                problem=f"mappings and lists stand more than {MAX_NESTING} deep in each other",
                problem_mark=self.peek_event().start_mark,
            )
        node = super().compose_node(parent, index)
        self._nesting -= 1
        return node


class Yaml12Dumper(yaml.SafeDumper):
    """Quotes exactly the strings that Yaml12Loader would not read as strings."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        """Write repeated values out."""
        return True


for _kind, _pattern, _first in _RESOLVERS:
    for _class in (Yaml12Loader, Yaml12Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_kind}",
            re.compile(f"^(?:{_pattern})$"),
            [c if c != "\0" else "" for c in _first],
        )


def scalar_value(tag: str, text: str) -> Any:
    """The value of a scalar of a resolved `tag`; raises ValueError for a text that has none.

    Raises OverflowError for an integer beyond 64 bits.
    """
    kind = tag.removeprefix("tag:yaml.org,2002:")
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() == "true"
    if kind == "int":
        base = {"0o": 8, "0x": 16}.get(text[:2], 10)
        if len(text) > 100 or abs(value := int(text, base)) > _LARGEST:
            raise OverflowError(f"an integer of {len(text)} digits does not fit into 64 bits")
        return value
    if kind == "float":
        return float(re.sub(r"\.(inf|nan)$", r"\1", text, flags=re.IGNORECASE))
    return text


def dump(value: Any, *, flow: bool | None = False) -> str:
    """`value` as YAML 1.2, keys in their order."""
    return yaml.dump(
        value, Dumper=Yaml12Dumper, sort_keys=False, default_flow_style=flow, width=10_000
    )


_STANDARD = "tag:yaml.org,2002:"
_TAGS = frozenset(
    _STANDARD + name for name in ("null", "bool", "int", "float", "str", "map", "seq")
)


def load_mapping(text: str, file: str, problems: Problems) -> MapNode:
    """The mapping in `text`; an empty one, and a problem, where there is something else."""
    node = load_text(text, file, problems)
    if isinstance(node, MapNode):
        return node
    if node is None:
        return MapNode(Origin(file, 1))
    if is_null(node):
        fix = "write a recipe, at least `recipe: 1`"
        problems.stop(Origin(file, 1), "", "the file is empty", fix)
        return MapNode(Origin(file, 1))
    problems.stop(
        node.origin,
        "",
        f"a recipe is a mapping, this is {kind_of(node)}",
        "write `key: value` lines, the first of them `recipe: 1`",
    )
    return MapNode(node.origin)


def load_text(
    text: str, file: str, problems: Problems, line: int | None = None, path: KeyPath = ()
) -> Node | None:
    """The tree of `text`, a null for an empty text; None, and a problem, for what is no YAML.

    line: given to every node in place of its own line. path: where the text belongs.
    """
    try:
        root = yaml.compose(text, Loader=Yaml12Loader)
    except yaml.YAMLError as error:
        _stop_at_syntax(error, text, file, path, problems, line)
        return None
    if root is None:
        return ScalarNode(Origin(file, 1 if line is None else line), None)
    return _Reader(file, problems, line).read(root, path)


class _Reader:
    def __init__(self, file: str, problems: Problems, line: int | None) -> None:
        self.file = file
        self.problems = problems
        self.line = line
        self.open: list[yaml.Node] = []

    def origin(self, node: yaml.Node) -> Origin:
        line = node.start_mark.line + 1 if self.line is None else self.line
        return Origin(self.file, line)

    def read(self, node: yaml.Node, path: KeyPath) -> Node:
        if any(node is parent for parent in self.open):
            return self.refuse(
                node, path, "an alias stands inside its own anchor", "write the value out"
            )
        if node.tag not in _TAGS:
            return self.refuse(
                node,
                path,
                f"the tag {node.tag!r} is not allowed in a recipe",
                "remove the tag; components are named with `type`",
            )
        self.open.append(node)
        try:
            if isinstance(node, yaml.MappingNode):
                return self.read_mapping(node, path)
            if isinstance(node, yaml.SequenceNode):
                items = (self.read(item, (*path, str(i))) for i, item in enumerate(node.value))
                return ListNode(self.origin(node), tuple(items))
            return self.read_scalar(node, path)
        finally:
            self.open.pop()

    def read_mapping(self, node: yaml.MappingNode, path: KeyPath) -> MapNode:
        items: dict[str, Node] = {}
        keys: dict[str, Origin] = {}
        for key_node, value_node in node.value:
            key = self.read_key(key_node, path)
            if key is None:
                continue
            if key in keys:
                self.add(
                    key_node,
                    (*path, key),
                    f"the key `{key}` is already given at {keys[key]}",
                    "keep one of the two",
                )
                continue
            keys[key] = self.origin(key_node)
            items[key] = self.read(value_node, (*path, key))
        return MapNode(self.origin(node), items, keys)

    def read_key(self, node: yaml.Node, path: KeyPath) -> str | None:
        if not isinstance(node, yaml.ScalarNode):
            self.add(node, path, "a key is a mapping or a list", "use a plain word as the key")
            return None
        if node.value == "<<" and node.style is None:
            self.add(
                node,
                (*path, "<<"),
                "merge keys (`<<`) are not part of YAML 1.2",
                "write the keys out, or share them between files with `extends`",
            )
            return None
        return node.value

    def read_scalar(self, node: yaml.Node, path: KeyPath) -> ScalarNode:
        try:
            return ScalarNode(self.origin(node), scalar_value(node.tag, node.value))
        except OverflowError as error:
            return self.refuse(node, path, str(error), "write a smaller number")
        except ValueError:
            kind = node.tag.removeprefix(_STANDARD)
            return self.refuse(node, path, f"{node.value!r} is no {kind}", "remove the tag")

    def refuse(self, node: yaml.Node, path: KeyPath, reason: str, fix: str) -> ScalarNode:
        self.problems.stop(self.origin(node), ".".join(path), reason, fix)
        return ScalarNode(self.origin(node), None)

    def add(self, node: yaml.Node, path: KeyPath, reason: str, fix: str) -> None:
        self.problems.add(self.origin(node), ".".join(path), reason, fix)


def _stop_at_syntax(
    error: yaml.YAMLError, text: str, file: str, path: KeyPath, problems: Problems, line: int | None
) -> None:
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    number = mark.line + 1 if mark else 1
    lines = text.splitlines()
    written = lines[number - 1] if number <= len(lines) else ""
    if isinstance(error, NestingError):
        reason, fix = str(error.problem), "write the recipe flatter"
    elif "\t" in written[: len(written) - len(written.lstrip())] or "'\\t'" in str(error):
        reason, fix = "a tab stands where YAML wants spaces", "indent with spaces"
    else:
        reason = f"this is no valid YAML: {getattr(error, 'problem', None) or error}"
        fix = "correct the line; check indentation, brackets, quotes and `: ` before it"
    origin = Origin(file, number if line is None else line)
    problems.stop(origin, ".".join(path), reason, fix)

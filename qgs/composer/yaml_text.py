"""YAML text to nodes, as YAML 1.2 reads scalars, and values to YAML text."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import yaml

from qgs.composer.errors import Problems
from qgs.composer.nodes import (
    LARGEST,
    Count,
    KeyPath,
    ListNode,
    MapNode,
    Node,
    Origin,
    RecipeSizeError,
    kind_of,
    shortened,
    text_fault,
)

_STANDARD = "tag:yaml.org,2002:"
_TAGS = {_STANDARD + name for name in ("null", "bool", "int", "float", "str", "map", "seq")}
_RESOLVERS = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", "-+.0123456789"),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", "-+."),
)


class Yaml12Loader(yaml.SafeLoader):
    """Composes nodes with YAML 1.2 tags; `scalar_value` reads their values."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._nesting = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """PyYAML's, refusing what would overflow the stack of whoever walks the tree."""
        with sized(self.peek_event().start_mark):
            Count().one(self._nesting)  # its depth alone: values are counted by _Reader
        self._nesting += 1
        node = super().compose_node(parent, index)
        self._nesting -= 1
        return node


class Yaml12Dumper(yaml.SafeDumper):
    """Quotes exactly the strings that Yaml12Loader would not read as strings."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        """Write repeated values out."""
        return True


class SizeError(yaml.MarkedYAMLError):
    """A RecipeSizeError, and where."""


@contextmanager
def sized(mark: yaml.Mark) -> Iterator[None]:
    """Raise a RecipeSizeError of the block as a SizeError at `mark`."""
    try:
        yield
    except RecipeSizeError as error:
        raise SizeError(problem=str(error), problem_mark=mark) from None


for _kind, _pattern, _first in _RESOLVERS:
    for _class in (Yaml12Loader, Yaml12Dumper):
        _full = re.compile(f"^(?:{_pattern})$")
        _class.add_implicit_resolver(_STANDARD + _kind, _full, list(_first))


def scalar_value(tag: str, text: str) -> Any:
    """The value of a scalar of a resolved `tag`; raises ValueError for a text that has none.

    Raises OverflowError for an integer beyond 64 bits.
    """
    kind = tag.removeprefix(_STANDARD)
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() == "true"
    if kind == "int":
        base = {"0o": 8, "0x": 16}.get(text[:2], 10)
        if len(text) > 100 or abs(value := int(text, base)) > LARGEST:
            raise OverflowError(f"an integer of {len(text)} digits does not fit into 64 bits")
        return value
    if kind == "float":
        return float(re.sub(r"\.(inf|nan)$", r"\1", text, flags=re.IGNORECASE))
    return text


def dump(value: Any, *, flow: bool | None = False) -> str:
    """`value` as YAML 1.2, keys in their order."""
    style: Any = {"default_flow_style": flow, "sort_keys": False, "width": 10_000}
    return yaml.dump(value, Dumper=Yaml12Dumper, **style)


def inline(value: Any) -> str:
    """`value` as YAML 1.2 on one line."""
    return dump(value, flow=True).removesuffix("\n").removesuffix("\n...")


def load_mapping(text: str, file: str, problems: Problems, count: Count | None = None) -> MapNode:
    """The mapping in `text`; an empty one, and a problem, where there is something else."""
    node = load_text(text, file, problems, count=count)
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
    text: str,
    file: str,
    problems: Problems,
    line: int | None = None,
    path: KeyPath = (),
    count: Count | None = None,
) -> Node:
    """The value of `text`; an empty mapping, and a problem, where it is no YAML.

    line: given to every node in place of its own line. path: where the text belongs. count: of the
    values of the recipe so far.
    """
    try:
        root = yaml.compose(text, Loader=Yaml12Loader)
        return (
            None
            if root is None
            else _Reader(file, problems, line, count or Count()).read(root, path)
        )
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        before = getattr(error, "position", 0)  # of a ReaderError, which has no mark
        number = 1 + (mark.line if mark else text.count("\n", 0, before))
        origin = Origin(file, number if line is None else line)
        reason, fix = _explain(error, "".join(text.splitlines()[number - 1 : number]))
        problems.stop(origin, ".".join(path), reason, fix)
        return MapNode(origin)


def _explain(error: yaml.YAMLError, written: str) -> tuple[str, str]:
    """Reason and fix. written: the line that the parser complains about."""
    if isinstance(error, SizeError):
        return str(error.problem), RecipeSizeError.fix
    if "\t" in written[: len(written) - len(written.lstrip())] or "'\\t'" in str(error):
        return "a tab stands where YAML wants spaces", "indent with spaces"
    if isinstance(error, yaml.reader.ReaderError):
        return f"the character {chr(error.character)!r} is not allowed in YAML", "remove it"
    reason = f"this is no valid YAML: {getattr(error, 'problem', None) or error}"
    return reason, "correct the line; check indentation, brackets, quotes and `: ` before it"


class _Reader:
    """Turns PyYAML's nodes into ours. line: see `load_text`."""

    def __init__(self, file: str, problems: Problems, line: int | None, count: Count) -> None:
        self.file, self.problems, self.line, self.count = file, problems, line, count
        self.open: list[yaml.Node] = []

    def origin(self, node: yaml.Node) -> Origin:
        return Origin(self.file, node.start_mark.line + 1 if self.line is None else self.line)

    def read(self, node: yaml.Node, path: KeyPath) -> Node:
        if any(node is parent for parent in self.open):
            return self.stop(node, path, "an alias stands inside its own anchor", "remove it")
        with sized(node.start_mark):
            self.count.one(len(path))
        if node.tag not in _TAGS:
            fix = "remove the tag; components are named with `type`"
            return self.stop(node, path, f"the tag {node.tag!r} is not allowed in a recipe", fix)
        if isinstance(node, yaml.ScalarNode):
            try:
                value = scalar_value(node.tag, node.value)
                fault = text_fault(value) if isinstance(value, str) else ""
                text = f"{shortened(repr(value))} {fault}"
                return self.stop(node, path, text, "remove it") if fault else value
            except OverflowError as error:
                return self.stop(node, path, str(error), "write a smaller number")
            except ValueError:
                kind = node.tag.removeprefix(_STANDARD)
                text = f"{shortened(repr(node.value))} is no {kind}"
                return self.stop(node, path, text, "remove the tag")
        self.open.append(node)
        try:
            if isinstance(node, yaml.MappingNode):
                return self.read_mapping(node, path)
            items = (
                (self.read(x, (*path, str(i))), self.origin(x)) for i, x in enumerate(node.value)
            )
            return ListNode(self.origin(node), items)
        finally:
            self.open.pop()

    def read_mapping(self, node: yaml.MappingNode, path: KeyPath) -> MapNode:
        read: dict[str, tuple[str, Node, Origin]] = {}
        for key_node, value_node in node.value:
            key, origin, reason = key_node.value, self.origin(key_node), ""
            if not isinstance(key_node, yaml.ScalarNode):
                key, reason, fix = "", "a key is a mapping or a list", "use a plain word as the key"
            elif key == "<<" and key_node.style is None:
                reason = "merge keys (`<<`) are not part of YAML 1.2"
                fix = "write the keys out, or share them between files with `extends`"
            elif text_fault(key):
                reason, fix = f"the key {shortened(repr(key))} {text_fault(key)}", "remove it"
            elif key in read:
                reason = f"the key `{key}` is already given at {read[key][2]}"
                fix = "keep one of the two"
            if reason:
                self.problems.add(origin, ".".join((*path, key)).removesuffix("."), reason, fix)
            else:
                read[key] = (key, self.read(value_node, (*path, key)), origin)
        return MapNode(self.origin(node), read.values())

    def stop(self, node: yaml.Node, path: KeyPath, reason: str, fix: str) -> None:
        self.problems.stop(self.origin(node), ".".join(path), reason, fix)

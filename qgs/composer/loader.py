"""One YAML text to a tree of nodes."""

from __future__ import annotations

import yaml

from qgs.composer.errors import Problems
from qgs.composer.nodes import ListNode, MapNode, Node, Origin, Path, ScalarNode, is_null, kind_of
from qgs.composer.yaml12 import NestingError, Yaml12Loader, scalar_value

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
    text: str, file: str, problems: Problems, line: int | None = None, path: Path = ()
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

    def read(self, node: yaml.Node, path: Path) -> Node:
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

    def read_mapping(self, node: yaml.MappingNode, path: Path) -> MapNode:
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

    def read_key(self, node: yaml.Node, path: Path) -> str | None:
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

    def read_scalar(self, node: yaml.Node, path: Path) -> ScalarNode:
        try:
            return ScalarNode(self.origin(node), scalar_value(node.tag, node.value))
        except OverflowError as error:
            return self.refuse(node, path, str(error), "write a smaller number")
        except ValueError:
            kind = node.tag.removeprefix(_STANDARD)
            return self.refuse(node, path, f"{node.value!r} is no {kind}", "remove the tag")

    def refuse(self, node: yaml.Node, path: Path, reason: str, fix: str) -> ScalarNode:
        self.problems.stop(self.origin(node), ".".join(path), reason, fix)
        return ScalarNode(self.origin(node), None)

    def add(self, node: yaml.Node, path: Path, reason: str, fix: str) -> None:
        self.problems.add(self.origin(node), ".".join(path), reason, fix)


def _stop_at_syntax(
    error: yaml.YAMLError, text: str, file: str, path: Path, problems: Problems, line: int | None
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

"""`--set a.b=c`: overrides given beside a recipe, read by the same loader as its files."""

from __future__ import annotations

from collections.abc import Sequence

from qgs.composer.errors import Problems
from qgs.composer.loader import load_text
from qgs.composer.merge import merge
from qgs.composer.nodes import MapNode, Node, Origin


def apply_overrides(tree: MapNode, overrides: Sequence[str], problems: Problems) -> MapNode:
    """`tree` with every override laid over it in order; the n-th has the origin `--set #n`."""
    if isinstance(overrides, str):
        problems.stop(
            Origin("overrides"),
            "",
            f"overrides are a list of strings, got the string {overrides!r}",
            f"write `overrides=[{overrides!r}]`",
        )
        return tree
    for number, text in enumerate(overrides, start=1):
        over = _read_override(text, Origin(f"--set #{number}"), problems)
        if over is not None:
            merged = merge(tree, over)
            assert isinstance(merged, MapNode)
            tree = merged
    return tree


def _read_override(text: str, origin: Origin, problems: Problems) -> MapNode | None:
    name, equals, value = text.partition("=")
    path = name.strip().split(".")
    if not equals or not all(path):
        problems.add(
            origin,
            name.strip(),
            f"{text!r} is no override",
            "write `path.to.option=value`, such as `model.queries.count=128`",
        )
        return None
    if path[0] == "extends" or (path[0] == "swap" and len(path) > 1):
        fix = "write a recipe that extends both, or set single options"
        if path[0] == "swap":
            fix = "set the option itself, or give all swaps as `swap={PATTERN: {type: NAME}}`"
        problems.add(origin, name.strip(), f"an override cannot set `{name.strip()}`", fix)
        return None
    node = load_text(value, origin.file, problems, line=0, path=tuple(path))
    return None if node is None else _nest(path, node, origin)


def _nest(path: list[str], node: Node, origin: Origin) -> MapNode:
    for key in reversed(path):
        node = MapNode(origin, {key: node}, {key: origin})
    assert isinstance(node, MapNode)
    return node

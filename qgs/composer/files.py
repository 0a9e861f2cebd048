"""A recipe file with everything it extends, and `--set` overrides laid over it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from qgs.composer.errors import Problems, nearest
from qgs.composer.nodes import (
    KeyPath,
    ListNode,
    MapNode,
    Node,
    Origin,
    ScalarNode,
    from_plain,
    is_null,
)
from qgs.composer.slots import type_at
from qgs.composer.yaml_text import load_mapping, load_text

TAGS = ("type", "kind")
"""Keys that say what a mapping is; a node with another tag keeps nothing of the old one."""


def merge(base: Node, over: Node, path: KeyPath = ()) -> Node:
    """`over` laid over `base`, both at `path`.

    `null` replaces what it lies over: in place of an option it is a value, in place of a component
    or a section it leaves the default, in place of a swap it drops the swap.
    """
    if not (isinstance(base, MapNode) and isinstance(over, MapNode)):
        return over
    if _replaces(base, over, path):
        return over
    items, keys = dict(base.items), dict(base.keys)
    for key, node in over.items.items():
        below = (*path, key)
        if path == ("swap",) and is_null(node) and not is_null(base.items.get(key)):
            del items[key], keys[key]
            continue
        if below == ("plugins",):
            node = _united(items.get(key), node)
        items[key] = merge(items[key], node, below) if key in items else node
        keys[key] = over.keys[key]
    return MapNode(over.origin, items, keys)


def _united(base: Node | None, over: Node) -> Node:
    """The items of `base` and those that `over` adds, so that an overlay names its own plugins."""
    if not (isinstance(base, ListNode) and isinstance(over, ListNode)):
        return over
    known = [item.value for item in base.items if isinstance(item, ScalarNode)]
    added = (i for i in over.items if not (isinstance(i, ScalarNode) and i.value in known))
    return ListNode(over.origin, (*base.items, *added))


def _replaces(base: MapNode, over: MapNode, path: KeyPath) -> bool:
    if len(path) == 2 and path[0] == "swap":
        return True
    for tag in TAGS:
        if tag in over.items:
            before = type_at(base, path) if tag == "type" else _scalar(base, tag)
            after = type_at(over, path) if tag == "type" else _scalar(over, tag)
            if before is not None and before != after:
                return True
    return False


def _scalar(node: MapNode, key: str) -> object:
    value = node.items.get(key)
    return value.value if isinstance(value, ScalarNode) else None


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


def read_recipe(recipe: str | Path | Mapping[str, Any], problems: Problems) -> MapNode:
    """The merged tree of `recipe`, without its `extends`."""
    if isinstance(recipe, Mapping):
        try:
            node = from_plain(recipe, Origin("<mapping>"))
        except RecursionError:
            reason = "the mapping is nested too deep, or contains itself"
            problems.stop(Origin("<mapping>"), "", reason, "write the recipe flatter")
            node = MapNode(Origin("<mapping>"))
        assert isinstance(node, MapNode)
        return _with_bases(node, Path(), (), problems)
    return _read_file(Path(recipe), (), None, problems)


def _read_file(
    file: Path, chain: tuple[Path, ...], extended_at: Origin | None, problems: Problems
) -> MapNode:
    asked = extended_at or Origin(str(file))
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        _report_unreadable(file, error, chain, extended_at, problems)
        return MapNode(asked)
    except UnicodeDecodeError:
        problems.stop(Origin(str(file)), "", "the file is no UTF-8 text", "save it as UTF-8")
        return MapNode(asked)
    node = load_mapping(text, str(file), problems)
    return _with_bases(node, file.parent, (*chain, file), problems)


def _with_bases(
    node: MapNode, folder: Path, chain: tuple[Path, ...], problems: Problems
) -> MapNode:
    merged: Node | None = None
    for name, origin in _extended(node, problems):
        file = Path(os.path.normpath(folder / name))
        visited = [path.resolve() for path in chain]
        if file.resolve() in visited:
            circle = [*chain[visited.index(file.resolve()) :], file]
            problems.stop(
                origin,
                "extends",
                f"recipes extend each other in a circle: {' -> '.join(map(str, circle))}",
                "remove one `extends` of the circle",
            )
            continue
        base = _read_file(file, chain, origin, problems)
        merged = base if merged is None else merge(merged, base)
    own = node.without("extends")
    result = own if merged is None else merge(merged, own)
    assert isinstance(result, MapNode)
    return result


def _extended(node: MapNode, problems: Problems) -> list[tuple[str, Origin]]:
    written = node.items.get("extends")
    if written is None or is_null(written):
        return []
    items = written.items if isinstance(written, ListNode) else (written,)
    names: list[tuple[str, Origin]] = []
    for item in items:
        if isinstance(item, ScalarNode) and isinstance(item.value, str | os.PathLike):
            names.append((str(item.value), item.origin))
        else:
            problems.stop(
                node.keys["extends"],
                "extends",
                "`extends` names one recipe file or a list of them",
                "write `extends: base.yaml`, relative to this file",
            )
    return names


def _report_unreadable(
    file: Path,
    error: OSError,
    chain: tuple[Path, ...],
    extended_at: Origin | None,
    problems: Problems,
) -> None:
    reason = f"{file} cannot be read: {error.strerror}"
    fix = "give the path of a recipe file"
    if isinstance(error, FileNotFoundError):
        reason = f"{file} does not exist"
        near = nearest(file.stem, [p.stem for p in file.parent.glob("*.yaml") if p not in chain])
        fix = f"did you mean `{file.parent / near}.yaml`?" if near else "check the path"
        if extended_at:
            home = "the file it stands in" if chain else "the working directory"
            fix += f" (`extends` is relative to {home})"
    origin = extended_at or Origin(str(file))
    problems.stop(origin, "extends" if extended_at else "", reason, fix)

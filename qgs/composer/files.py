"""A recipe file, or a mapping, with everything it extends."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qgs.composer.errors import Problems
from qgs.composer.loader import load_mapping
from qgs.composer.merge import merge
from qgs.composer.nodes import ListNode, MapNode, Node, Origin, ScalarNode, from_plain, is_null
from qgs.composer.suggest import nearest


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

"""A recipe file with everything it extends, and `--set` overrides laid over it."""

import os
from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import qgs
from qgs.composer.errors import Problems, nearest
from qgs.composer.nodes import KeyPath, ListNode, MapNode, Node, Origin, from_plain
from qgs.composer.slots import type_at
from qgs.composer.yaml_text import load_mapping, load_text


def merge(base: MapNode, over: MapNode, path: KeyPath = ()) -> MapNode:
    """`over` laid over `base`, both at `path`.

    A component of another `type`, or a mapping of another `kind`, keeps nothing of the old one.
    `plugins` are united, other lists replaced. `null` replaces what it lies over: in place of an
    option it is a value, in place of a component or a section it leaves the default, in place of
    a swap it drops the swap.
    """
    other_type = "type" in over and type_at(base, path) not in (None, type_at(over, path))
    other_kind = "kind" in over and base.get("kind") not in (None, over["kind"])
    if other_type or other_kind or (path[:1] == ("swap",) and len(path) == 2):
        return over
    merged = MapNode(over.origin, base.entries())
    for key, value, origin in over.entries():
        below, old = (*path, key), base.get(key)
        if path == ("swap",) and value is None and old is not None:
            del merged[key]
            continue
        if below == ("plugins",) and isinstance(old, ListNode) and isinstance(value, ListNode):
            added = [item for item in zip(value, value.origins, strict=True) if item[0] not in old]
            value = ListNode(value.origin, [*zip(old, old.origins, strict=True), *added])
        elif isinstance(old, MapNode) and isinstance(value, MapNode):
            value = merge(old, value, below)
        merged[key], merged.origins[key] = value, origin
    return merged


def recipe_folder() -> Path:
    """The recipes that come with qgs: in its wheel, else in the repository that it runs from."""
    package = Path(qgs.__file__).parent
    inside = package / "recipes"
    return inside if inside.is_dir() else package.parent / "recipes"


def found_recipe(file: Path, name: str | Path) -> Path:
    """`file` where it exists, else the recipe called `name`, if there is one, of `recipe_folder`.

    name: such as tiny/locus.yaml, or recipes/tiny/locus.yaml.
    """
    home = recipe_folder()
    for folder in (home, home.parent):
        shipped = Path(os.path.normpath(folder / name))
        if not file.exists() and shipped.is_relative_to(home) and shipped.is_file():
            return shipped
    return file


def read_recipe(recipe: str | Path | Mapping[str, Any], problems: Problems) -> MapNode:
    """The merged tree of `recipe`, without its `extends`."""
    if not isinstance(recipe, Mapping):
        return _read_file(found_recipe(Path(recipe), recipe), (), None, problems)
    origin = Origin("<mapping>")
    try:
        node = from_plain(recipe, origin)
    except RecursionError:
        reason = "the mapping is nested too deep, or contains itself"
        problems.stop(origin, "", reason, "write the recipe flatter")
        return MapNode(origin)
    assert isinstance(node, MapNode)
    return _with_bases(node, Path(), (), problems)


def _read_file(
    file: Path, chain: tuple[Path, ...], extended_at: Origin | None, problems: Problems
) -> MapNode:
    """chain: the files that extend each other down to `file`. extended_at: the last `extends`."""
    origin = Origin(str(file))
    try:
        text = file.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        problems.stop(origin, "", "the file is no UTF-8 text", "save it as UTF-8")
        return MapNode(origin)
    except OSError as error:
        reason, fix = f"{file} cannot be read: {error.strerror}", "give the path of a recipe file"
        if isinstance(error, FileNotFoundError):
            stems = [path.stem for path in file.parent.glob("*.yaml") if path not in chain]
            near = nearest(file.stem, stems)
            reason = f"{file} does not exist"
            fix = (
                f"did you mean `{file.parent / near}.yaml`?"
                if near
                else "check the path, or take one of `qgs recipes`"
            )
        if extended_at:
            home = "the file it stands in" if chain else "the working directory"
            fix += f" (`extends` is relative to {home})"
        problems.stop(extended_at or origin, "extends" if extended_at else "", reason, fix)
        return MapNode(origin)
    node = load_mapping(text, str(file), problems)
    return _with_bases(node, file.parent, (*chain, file), problems)


def _with_bases(
    node: MapNode, folder: Path, chain: tuple[Path, ...], problems: Problems
) -> MapNode:
    """`node` laid over the files that it extends, the later ones over the earlier ones."""
    written, at = node.get("extends"), node.origins.get("extends", node.origin)
    if not isinstance(written, ListNode):
        written = ListNode(at, [] if written is None else [(written, at)])
    layers: list[MapNode] = []
    for name, origin in zip(written, written.origins, strict=True):
        if not isinstance(name, str):
            reason = "`extends` names one recipe file or a list of them"
            fix = "write `extends: base.yaml`, relative to this file"
            problems.stop(at, "extends", reason, fix)
            continue
        file = found_recipe(Path(os.path.normpath(folder / name)), name)
        visited = [path.resolve() for path in chain]
        if file.resolve() not in visited:
            layers.append(_read_file(file, chain, origin, problems))
            continue
        circle = [*chain[visited.index(file.resolve()) :], file]
        reason = f"recipes extend each other in a circle: {' -> '.join(map(str, circle))}"
        problems.stop(origin, "extends", reason, "remove one `extends` of the circle")
    return reduce(merge, [*layers, node.without("extends")])


def apply_overrides(tree: MapNode, overrides: Sequence[str], problems: Problems) -> MapNode:
    """`tree` with every override laid over it in order; the n-th has the origin `--set #n`."""
    if isinstance(overrides, str):
        reason = f"overrides are a list of strings, got the string {overrides!r}"
        problems.stop(Origin("overrides"), "", reason, f"write `overrides=[{overrides!r}]`")
        return tree
    overs = (_read_override(x, Origin(f"--set #{n}"), problems) for n, x in enumerate(overrides, 1))
    return reduce(merge, filter(None, overs), tree)


def _read_override(text: str, origin: Origin, problems: Problems) -> MapNode:
    name, equals, value = text.partition("=")
    name = name.strip()
    path = name.split(".")
    reason = f"an override cannot set `{name}`"
    if not equals or not all(path):
        reason = f"{text!r} is no override"
        fix = "write `path.to.option=value`, such as `model.queries.count=128`"
    elif path[0] == "extends":
        fix = "write a recipe that extends both, or set single options"
    elif path[0] == "swap" and len(path) > 1:
        fix = "set the option itself, or give all swaps as `swap={PATTERN: {type: NAME}}`"
    else:
        node: Node = load_text(value, origin.file, problems, line=0, path=tuple(path))
        for key in reversed(path):
            node = MapNode(origin, [(key, node, origin)])
        assert isinstance(node, MapNode)
        return node
    problems.add(origin, name, reason, fix)
    return MapNode(origin)

"""Reading of recipe files, of the files that they extend, and of `--set` overrides."""

import os
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

from qgs.paths import open_file
from qgs.recipe.errors import Origin, Problems
from qgs.recipe.slots import type_at
from qgs.recipe.yaml_text import (
    MAX_DEPTH,
    KeyPath,
    ListNode,
    MapNode,
    from_plain,
    items_of,
    load_mapping,
    load_text,
)
from qgs.wording import nearest

KINDS = ("kind", "schedule")
"""Options that decide which other options a mapping without `type` has."""
_Trees = dict[Path, MapNode | None]
"""Merged recipe of each file, by resolved path; None while the file is being read."""
_Merge = Callable[[MapNode, MapNode], MapNode]
"""Function that merges the second of two mappings, a file's, into the first, which it extends."""


def merge(base: MapNode, over: MapNode, path: KeyPath = ()) -> MapNode:
    """Merge the mapping `over` into `base`, both at `path` of a recipe. Values of `over` win.

    If `over` has another `type`, `kind` or `schedule` than `base`, it replaces `base` as a whole.
    Items of the list `plugins` are added to those of `base`; any other list is replaced. The value
    `null` is kept for an option. It restores the default of a component or section, and removes an
    entry of the section `swap`.
    """
    # Options of another component would be refused, or worse, mean something else.
    if _replaces(base, over, path):
        return over
    merged = MapNode(over.origin, base.entries())
    merged.under = base
    merged.over = over
    for key, value, origin in over.entries():
        below = (*path, key)
        old = base.get(key)
        if path == ("swap",) and value is None and old is not None:
            del merged[key]
            continue
        if below == ("plugins",) and isinstance(old, list) and isinstance(value, list):
            # A file adds its plug-ins to those of its base.
            added = [item for item in items_of(value, origin) if item[0] not in old]
            value = ListNode([*items_of(old, base.origins[key]), *added])
        elif isinstance(old, MapNode) and isinstance(value, MapNode):
            value = merge(old, value, below)
        merged.put(key, value, origin)
    return merged


def _replaces(base: MapNode, over: MapNode, path: KeyPath) -> bool:
    """Return whether `over` replaces `base` as a whole. path: where both are in the recipe."""
    if path[:1] == ("swap",) and len(path) == 2:
        return True
    if "type" in over and type_at(base, path) not in (None, type_at(over, path)):
        return True
    kinds = [key for key in KINDS if key in over]
    return any(base.get(key) not in (None, over[key]) for key in kinds)


def recipe_folder() -> Path:
    """Return the folder of qgs's own recipes, in the installed package or in the repository."""
    package = Path(__file__).parents[1]
    inside = package / "recipes"
    return inside if inside.is_dir() else package.parent / "recipes"


def found_recipe(file: Path, name: str | Path) -> Path:
    """Return `file`, or the recipe `name` that comes with qgs if `file` does not exist.

    If neither exists, returns `file`. name: for example tiny/locus.yaml or recipes/tiny/locus.yaml.
    """
    # A wheel has no repository around it.
    home = recipe_folder()
    for folder in (home, home.parent):
        shipped = Path(os.path.normpath(folder / name))
        if not os.path.exists(file) and shipped.is_relative_to(home) and os.path.isfile(shipped):
            return shipped
    return file


def read_recipe(
    recipe: str | Path | Mapping[str, Any], problems: Problems, merging: _Merge = merge
) -> MapNode:
    """Read a recipe, or a file of another kind, and merge it over the files that it extends.

    merging: function that merges two files of this kind.
    """
    if not isinstance(recipe, Mapping):
        return _read(found_recipe(Path(recipe), recipe), {}, problems, merging)
    origin = Origin("<mapping>")
    try:
        # A study's variant is a mapping that knows where it was written.
        node = recipe if isinstance(recipe, MapNode) else from_plain(recipe, origin)
    except (ValueError, TypeError, RecursionError) as error:
        problems.stop(
            origin, "", str(error), "use only mappings, lists, strings, numbers, bools, None"
        )
    return _with_bases(node, Path(), {}, problems, merging)


def files_of(recipe: Path) -> list[Path]:
    """Return the real paths of a recipe file and of all files that it extends.

    Symbolic links are followed. Raises RecipeError if a file cannot be read.
    """
    trees: _Trees = {}
    _read(recipe, trees, Problems(), merge)
    return [*trees]


def _read(
    file: Path, trees: _Trees, problems: Problems, merging: _Merge, at: Origin | None = None
) -> MapNode:
    """Read `file` and merge it, by `merging`, over the files that it extends.

    trees: recipes read so far, by file. at: line that extends `file`; None for the first file.
    """
    # Two files may extend the same third one, by links as well.
    place = Path(os.path.realpath(file))
    if known := trees.get(place):
        return known
    option = "extends" if at else problems.what
    at = at or Origin(str(file))
    fix = "check the path, or choose a recipe from `qgs recipes`, or a study of recipes/studies"
    try:
        with open_file(file) as opened:
            text = opened.read().decode("utf-8")
    except FileNotFoundError:
        # Do not suggest a file that would extend itself.
        neighbours = [x.stem for x in file.parent.glob("*.yaml") if x.resolve() not in trees]
        if near := nearest(file.stem, neighbours):
            fix = f"did you mean `{file.parent / near}.yaml`?"
        problems.stop(at, option, f"{file} does not exist", fix)
    # ValueError: an impossible file name, or text that is not UTF-8.
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        problems.stop(at, option, f"{file} cannot be read: {why}", fix)
    trees[place] = None
    trees[place] = tree = _with_bases(
        load_mapping(text, str(file), problems), file.parent, trees, problems, merging
    )
    return tree


def _with_bases(
    node: MapNode, folder: Path, trees: _Trees, problems: Problems, merging: _Merge
) -> MapNode:
    """Merge the recipe `node` over the files that it extends; later files win over earlier ones."""
    layers: list[MapNode] = []
    for name, origin in items_of(node.get("extends"), node.origin_of("extends")):
        if not isinstance(name, str):
            reason = f"`extends` must be a {problems.what} file or a list of {problems.what} files"
            fix = "write `extends: base.yaml`, relative to this file"
            problems.stop(origin, "extends", reason, fix)
        # `..` must not follow links: the path of a base is read as written.
        file = found_recipe(Path(os.path.normpath(folder / name)), name)
        place = Path(os.path.realpath(file))
        if place in (above := [path for path, tree in trees.items() if tree is None]):
            circle = [*above[above.index(place) :], place]
            reason = f"files extend each other: {' -> '.join(path.name for path in circle)}"
            problems.stop(origin, "extends", reason, "remove the `extends` of one of these files")
        layers.append(_read(file, trees, problems, merging, origin))
    return reduce(merging, [*layers, node.without("extends")])


def apply_overrides(tree: MapNode, overrides: Sequence[str], problems: Problems) -> MapNode:
    """Apply overrides to a recipe in order. Messages call the n-th override `--set #n`."""
    for number, text in enumerate(overrides, start=1):
        # One by one: an override may set an option of a component that the one before chose.
        tree = merge(tree, _read_override(text, Origin(f"--set #{number}"), problems))
    return tree


def _read_override(text: str, origin: Origin, problems: Problems) -> MapNode:
    name, equals, value = text.partition("=")
    path = tuple(name.strip().split("."))
    if not equals or not all(path) or len(path) > MAX_DEPTH:
        fix = "write `path.to.option=value`, such as `model.queries.count=128`"
        problems.add(origin, path, f"{text!r:.100} is not an override", fix)
        return MapNode(origin)
    node: Any = load_text(value, origin.file, problems, 0, path)
    for key in reversed(path):
        node = MapNode(origin, [(key, node, origin)])
    return node

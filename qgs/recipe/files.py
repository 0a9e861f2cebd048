"""A recipe file with everything it extends, and `--set` overrides laid over it."""

import os
from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

from qgs.paths import open_file
from qgs.recipe.errors import Origin, Problems, nearest
from qgs.recipe.slots import type_at
from qgs.recipe.yaml_text import (
    MAX_DEPTH,
    KeyPath,
    ListNode,
    MapNode,
    Node,
    from_plain,
    items_of,
    load_mapping,
    load_text,
)


def merge(base: MapNode, over: MapNode, path: KeyPath = ()) -> MapNode:
    """`over` laid over `base`, both at `path`.

    A component of another `type`, or a mapping of another `kind` or `schedule`, keeps nothing of
    the old one. `plugins` are united, other lists replaced. `null` replaces what it lies over: in
    place of an option it is a value, in place of a component or a section it leaves the default, in
    place of a swap it drops the swap.
    """
    # Options of another component would be refused, or worse, mean something else.
    if _replaces(base, over, path):
        return over
    merged = MapNode(over.origin, base.entries())
    merged.under = base
    for key, value, origin in over.entries():
        below = (*path, key)
        old = base.get(key)
        if path == ("swap",) and value is None and old is not None:
            del merged[key]
            continue
        if below == ("plugins",) and isinstance(old, list) and isinstance(value, list):
            # A file names the plug-ins that it needs and leaves those of its base.
            added = [item for item in items_of(value, origin) if item[0] not in old]
            value = ListNode(origin, [*items_of(old, base.origins[key]), *added])
        elif isinstance(old, MapNode) and isinstance(value, MapNode):
            value = merge(old, value, below)
        merged.put(key, value, origin)
    return merged


def _replaces(base: MapNode, over: MapNode, path: KeyPath) -> bool:
    """Return whether nothing of `base` stays under `over`."""
    if path[:1] == ("swap",) and len(path) == 2:
        return True
    if "type" in over and type_at(base, path) not in (None, type_at(over, path)):
        return True
    kinds = [key for key in ("kind", "schedule") if key in over]
    return any(base.get(key) not in (None, over[key]) for key in kinds)


def recipe_folder() -> Path:
    """The recipes that come with qgs: in its wheel, else in the repository that it runs from."""
    package = Path(__file__).parents[1]
    inside = package / "recipes"
    return inside if inside.is_dir() else package.parent / "recipes"


def found_recipe(file: Path, name: str | Path) -> Path:
    """`file` where it exists, else the recipe called `name`, if there is one, of `recipe_folder`.

    name: such as tiny/locus.yaml, or recipes/tiny/locus.yaml.
    """
    # A wheel has no repository around it.
    home = recipe_folder()
    for folder in (home, home.parent):
        shipped = Path(os.path.normpath(folder / name))
        if not os.path.exists(file) and shipped.is_relative_to(home) and os.path.isfile(shipped):
            return shipped
    return file


def read_recipe(recipe: str | Path | Mapping[str, Any], problems: Problems) -> MapNode:
    """The merged tree of `recipe`, without its `extends`."""
    files = _Files(problems)
    if not isinstance(recipe, Mapping):
        return files.read(found_recipe(Path(recipe), recipe), (), None)
    origin = Origin("<mapping>")
    try:
        # A study's variant is a mapping that knows where it was written.
        node = recipe if isinstance(recipe, MapNode) else from_plain(recipe, origin)
    except (ValueError, TypeError, RecursionError) as error:
        problems.stop(origin, "", str(error), "give mappings, lists, strings, numbers, bools, None")
        return MapNode(origin)
    return files.with_bases(node, Path(), ())


def files_of(recipe: Path) -> list[Path]:
    """A recipe file and all that it extends, each once, links resolved; raises RecipeError."""
    problems = Problems()
    files = _Files(problems)
    files.read(recipe, (), None)
    problems.raise_any()
    return [*files.trees]


class _Files:
    """Reads the files of one recipe, each once. trees: by resolved path."""

    def __init__(self, problems: Problems) -> None:
        self.problems = problems
        self.trees: dict[Path, MapNode] = {}

    def read(self, file: Path, chain: tuple[Path, ...], extended_at: Origin | None) -> MapNode:
        """The merged tree of `file`, an empty one, and a problem, where that fails.

        chain: the files that extend each other down to `file`. extended_at: the last `extends`.
        """
        # Two files may extend the same third one, by links as well.
        place = Path(os.path.realpath(file))
        if place in self.trees:
            return self.trees[place]
        origin = Origin(str(file))
        try:
            with open_file(file) as opened:
                text = opened.read().decode("utf-8")
        except UnicodeDecodeError:
            self.problems.stop(origin, "", "this is no UTF-8 text", "save it as UTF-8")
            return MapNode(origin)
        # ValueError: no name that a file can have.
        except (OSError, ValueError) as error:
            reason, fix = _why_unreadable(file, error, chain)
            if extended_at:
                home = "the file it stands in" if chain else "the working directory"
                fix += f" (`extends` is relative to {home})"
            option = "extends" if extended_at else ""
            self.problems.stop(extended_at or origin, option, reason, fix)
            return MapNode(origin)
        node = load_mapping(text, str(file), self.problems)
        self.trees[place] = self.with_bases(node, file.parent, (*chain, file))
        return self.trees[place]

    def with_bases(self, node: MapNode, folder: Path, chain: tuple[Path, ...]) -> MapNode:
        """`node` laid over the files that it extends, the later ones over the earlier ones."""
        at = node.origin_of("extends")
        layers: list[MapNode] = []
        for name, origin in items_of(node.get("extends"), at):
            if not isinstance(name, str):
                reason = "`extends` names one recipe file or a list of them"
                fix = "write `extends: base.yaml`, relative to this file"
                self.problems.stop(at, "extends", reason, fix)
                continue
            # `..` must not follow links: a recipe names its base as it is written.
            file = found_recipe(Path(os.path.normpath(folder / name)), name)
            above = [os.path.realpath(link) for link in chain]
            place = os.path.realpath(file)
            if place in above:
                circle = " -> ".join(map(str, [*chain[above.index(place) :], file]))
                reason = f"recipes extend each other in a circle: {circle}"
                self.problems.stop(origin, "extends", reason, "remove one `extends` of the circle")
            else:
                layers.append(self.read(file, chain, origin))
        return reduce(merge, [*layers, node.without("extends")])


def _why_unreadable(file: Path, error: Exception, chain: Sequence[Path]) -> tuple[str, str]:
    """Reason and fix."""
    if not isinstance(error, FileNotFoundError):
        why = getattr(error, "strerror", None) or error
        return f"{file} cannot be read: {why}", "check the path, or take one of `qgs recipes`"
    # A file that extends itself would be a poor advice.
    neighbours = [path.stem for path in file.parent.glob("*.yaml") if path not in chain]
    near = nearest(file.stem, neighbours)
    fix = "check the path, or take one of `qgs recipes`"
    return f"{file} does not exist", f"did you mean `{file.parent / near}.yaml`?" if near else fix


def apply_overrides(tree: MapNode, overrides: Sequence[str], problems: Problems) -> MapNode:
    """`tree` with every override laid over it in order; the n-th has the origin `--set #n`."""
    assert not isinstance(overrides, str), f"overrides are a list of strings: [{overrides!r}]"
    for number, text in enumerate(overrides, start=1):
        # One by one: an override may set an option of a component that the one before chose.
        tree = merge(tree, _read_override(text, Origin(f"--set #{number}"), problems))
    return tree


def _read_override(text: str, origin: Origin, problems: Problems) -> MapNode:
    name, equals, value = text.partition("=")
    name = name.strip()
    path = tuple(name.split("."))
    reason = f"an override cannot set `{name}`"
    if not equals or not all(path) or len(path) > MAX_DEPTH:
        reason = f"{text!r:.100} is no override"
        fix = "write `path.to.option=value`, such as `model.queries.count=128`"
    elif path[0] == "extends":
        fix = "write a recipe that extends both, or set single options"
    # Patterns have dots as well, so that the path would end nobody knows where.
    elif path[0] == "swap" and len(path) > 1:
        fix = "set the option itself, or give all swaps as `swap={PATTERN: {type: NAME}}`"
    else:
        node: Node = load_text(value, origin.file, problems, 0, path)
        for key in reversed(path):
            node = MapNode(origin, [(key, node, origin)])
        assert isinstance(node, MapNode)
        return node
    problems.add(origin, name, reason, fix)
    return MapNode(origin)

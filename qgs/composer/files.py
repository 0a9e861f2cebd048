"""A recipe file with everything it extends, and `--set` overrides laid over it."""

import errno
import json
import os
import stat
from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import qgs
from qgs.composer.errors import Problems, nearest
from qgs.composer.nodes import (
    MAX_NESTING,
    Count,
    KeyPath,
    ListNode,
    MapNode,
    Node,
    Origin,
    RecipeSizeError,
    UnfitValueError,
    from_plain,
    shortened,
    text_fault,
)
from qgs.composer.slots import type_at
from qgs.composer.yaml_text import load_mapping, load_text

MAX_BYTES = 256 * 1024
"""Of all files of a recipe together; the longest that we ship resolves to 10 KiB."""
MAX_EXTENDS = 64
"""Names in all `extends` of a recipe's files together, each file's counted once."""


def refuse_beyond_reading(resolved: Mapping[str, Any], origin: Origin, problems: Problems) -> None:
    """Add a problem for a resolved recipe that no run or checkpoint could be read with again."""
    try:
        from_plain(resolved, origin, Count())
        if len(json.dumps(resolved)) > MAX_BYTES:
            raise RecipeSizeError(f"it is longer than {MAX_BYTES // 1024} KiB")
    except RecipeSizeError as error:
        fix = "name fewer losses, metrics and parts, with shorter names and values"
        problems.add(origin, "", f"with every option written out, {error}", fix)


def merge(base: MapNode, over: MapNode, path: KeyPath = ()) -> MapNode:
    """`over` laid over `base`, both at `path`.

    A component of another `type`, or a mapping of another `kind` or `schedule`, keeps nothing of
    the old one.
    `plugins` are united, other lists replaced. `null` replaces what it lies over: in place of an
    option it is a value, in place of a component or a section it leaves the default, in place of
    a swap it drops the swap.
    """
    other_type = "type" in over and type_at(base, path) not in (None, type_at(over, path))
    told = [key for key in ("kind", "schedule") if key in over]
    other_kind = any(base.get(key) not in (None, over[key]) for key in told)
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
        if not os.path.exists(file) and shipped.is_relative_to(home) and os.path.isfile(shipped):
            return shipped
    return file


def read_recipe(
    recipe: str | Path | Mapping[str, Any], problems: Problems, count: Count
) -> MapNode:
    """The merged tree of `recipe`, without its `extends`. count: of its values."""
    files = _Files(problems, count)
    if not isinstance(recipe, Mapping):
        return files.read(found_recipe(Path(recipe), recipe), (), None)
    if isinstance(recipe, MapNode):  # which knows where it was written
        return files.with_bases(recipe, Path(), ())
    origin = Origin("<mapping>")
    try:
        node = from_plain(recipe, origin, count)
    except UnfitValueError as error:
        problems.stop(origin, ".".join(error.path), str(error), error.fix)
    except RecipeSizeError as error:
        problems.stop(origin, "", f"{error}, or the mapping contains itself", error.fix)
    else:
        assert isinstance(node, MapNode)
        return files.with_bases(node, Path(), ())
    return MapNode(origin)


def files_of(recipe: Path) -> list[Path]:
    """A recipe file and all that it extends, each once, links resolved; raises RecipeError."""
    files = _Files(problems := Problems(), Count())
    files.read(recipe, (), None)
    problems.raise_any()
    return [Path(place) for place in files.trees]


class _Files:
    """Reads the files of one recipe, each once, whatever extends it. trees: by resolved path."""

    def __init__(self, problems: Problems, count: Count) -> None:
        self._problems, self._count = problems, count
        self.trees: dict[str, MapNode] = {}
        self._bytes = self._followed = 0

    def read(self, file: Path, chain: tuple[Path, ...], extended_at: Origin | None) -> MapNode:
        """The merged tree of `file`, an empty one, and a problem, where that fails.

        chain: the files that extend each other down to `file`. extended_at: the last `extends`.
        """
        origin = Origin(str(file))
        try:
            place = os.path.realpath(file)
            if place in self.trees:
                return self.trees[place]
            text = self._text(file)
        except UnicodeDecodeError:
            self._problems.stop(origin, "", "the file is no UTF-8 text", "save it as UTF-8")
            return MapNode(origin)
        except (OSError, ValueError) as error:  # ValueError: no name that a file can have
            reason, fix = _why_unread(file, error, chain)
            if extended_at:
                home = "the file it stands in" if chain else "the working directory"
                fix += f" (`extends` is relative to {home})"
            option = "extends" if extended_at else ""
            self._problems.stop(extended_at or origin, option, reason, fix)
            return MapNode(origin)
        node = load_mapping(text, str(file), self._problems, self._count)
        self.trees[place] = self.with_bases(node, file.parent, (*chain, file))
        return self.trees[place]

    def _text(self, file: Path) -> str:
        """Raises OSError, ValueError; nothing but a regular file is opened."""
        mode = file.stat().st_mode
        if stat.S_ISDIR(mode):
            what = "it is a folder; a recipe is a .yaml file, of a run its recipe.yaml"
            raise OSError(errno.EISDIR, what)
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "it is a device or a pipe, no regular file")
        with file.open("rb") as stream:
            written = stream.read(MAX_BYTES + 1 - self._bytes)
        self._bytes += len(written)
        if self._bytes > MAX_BYTES:
            size = f"the files of a recipe have {MAX_BYTES // 1024} KiB at most, all together"
            raise OSError(errno.EFBIG, size)
        return written.decode()

    def with_bases(self, node: MapNode, folder: Path, chain: tuple[Path, ...]) -> MapNode:
        """`node` laid over the files that it extends, the later ones over the earlier ones."""
        written, at = node.get("extends"), node.origins.get("extends", node.origin)
        if not isinstance(written, ListNode):
            written = ListNode(at, [] if written is None else [(written, at)])
        layers: list[MapNode] = []
        for name, origin in zip(written, written.origins, strict=True):
            if not isinstance(name, str):
                reason = "`extends` names one recipe file or a list of them"
                fix = "write `extends: base.yaml`, relative to this file"
                self._problems.stop(at, "extends", reason, fix)
                continue
            file = found_recipe(Path(os.path.normpath(folder / name)), name)
            same = [n for n, above in enumerate(chain) if _same_file(above, file)]
            self._followed += 1
            if same:
                circle = " -> ".join(map(str, [*chain[same[0] :], file]))
                reason = f"recipes extend each other in a circle: {circle}"
                self._problems.stop(origin, "extends", reason, "remove one `extends` of the circle")
            elif self._followed > MAX_EXTENDS:
                reason = f"this recipe and those that it extends name more than {MAX_EXTENDS} files"
                self._problems.stop(origin, "extends", reason, "extend fewer")
                break
            else:
                layers.append(self.read(file, chain, origin))
        return reduce(merge, [*layers, node.without("extends")])


def _same_file(a: Path, b: Path) -> bool:
    try:
        return a.samefile(b)
    except (OSError, ValueError):  # told when it is read
        return False


def _why_unread(file: Path, error: OSError | ValueError, chain: Sequence[Path]) -> tuple[str, str]:
    """Reason and fix for a recipe file that cannot be read."""
    shown = shortened(str(file), 300)
    if isinstance(error, FileNotFoundError):
        stems = [path.stem for path in file.parent.glob("*.yaml") if path not in chain]
        near = nearest(file.stem, stems)
        near_file = f"did you mean `{file.parent / near}.yaml`?" if near else ""
        fix = near_file or "check the path, or take one of `qgs recipes`"
        return f"{shown} does not exist", fix
    why = error.strerror if isinstance(error, OSError) else str(error)
    return f"{shown} cannot be read: {why}", "give the path of a recipe file"


def apply_overrides(
    tree: MapNode, overrides: Sequence[str], problems: Problems, count: Count
) -> MapNode:
    """`tree` with every override laid over it in order; the n-th has the origin `--set #n`.

    count: of the recipe's values so far.
    """
    if isinstance(overrides, str):
        reason = f"overrides are a list of strings, got the string {overrides!r}"
        problems.stop(Origin("overrides"), "", reason, f"write `overrides=[{overrides!r}]`")
        return tree
    origins = (Origin(f"--set #{n}") for n in range(1, len(overrides) + 1))
    overs = (
        _read_override(x, at, problems, count) for x, at in zip(overrides, origins, strict=True)
    )
    return reduce(merge, filter(None, overs), tree)


def _read_override(text: str, origin: Origin, problems: Problems, count: Count) -> MapNode:
    name, equals, value = text.partition("=")
    name = name.strip()
    path = name.split(".")
    reason = f"an override cannot set `{name}`"
    if not equals or not all(path):
        reason = f"{shortened(repr(text))} is no override"
        fix = "write `path.to.option=value`, such as `model.queries.count=128`"
    elif len(path) > MAX_NESTING or text_fault(name):
        reason = f"{shortened(repr(name))} {text_fault(name) or 'names no option'}"
        fix = "write `path.to.option=value`, such as `model.queries.count=128`"
    elif path[0] == "extends":
        fix = "write a recipe that extends both, or set single options"
    elif path[0] == "swap" and len(path) > 1:
        fix = "set the option itself, or give all swaps as `swap={PATTERN: {type: NAME}}`"
    else:
        node: Node = load_text(value, origin.file, problems, 0, tuple(path), count)
        for key in reversed(path):
            node = MapNode(origin, [(key, node, origin)])
        assert isinstance(node, MapNode)
        return node
    problems.add(origin, name, reason, fix)
    return MapNode(origin)

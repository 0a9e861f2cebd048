"""Description of the weights that another codebase publishes: names, and recipes that fit."""

import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qgs.checkpoint.tensors import Shapes


class LayoutError(ValueError):
    """Error for published names and shapes that fit no recipe; the message says why."""


def renamed(name: str, ours: str, theirs: str) -> str | None:
    """Return `name` with `ours` replaced by `theirs`; None if `ours` does not match.

    `{}` stands for the number of a layer. If `ours` ends with a dot it is a module, and the rest of
    the name stays the same.
    """
    # Only `{}` is a placeholder: dots in a name are plain dots.
    pattern = re.escape(ours).replace(r"\{\}", r"(\d+)")
    match = re.match(pattern if ours.endswith(".") else pattern + "$", name)
    if match is None:
        return None
    return theirs.format(*match.groups()) + name[match.end() :]


@dataclass(frozen=True)
class WeightLayout:
    """Names and shapes in the state dicts of one published codebase; see `layout`.

    name: name of the published model. plugin: plugin with its components.
    source: where it is published.
    components: slot -> component types of the codebase; other slots may hold any component.
    renames: our name -> published name of modules and parameters, see `renamed`; the first that
        matches counts.
    marks: published names that identify this layout; its files have all of them.
    unused: pairs of a published name and a parameter stored with it that the published code
        ignores.
    read: function from names and shapes of a state dict to a recipe that fits, a mapping with
        `recipe: 1`; raises LayoutError.
    undecided: texts about options that names and shapes leave open, with the published value that
        `read` chooses.
    """

    name: str
    plugin: str
    source: str
    components: Mapping[str, Sequence[str]]
    renames: Mapping[str, str]
    marks: Sequence[str]
    read: Callable[[Shapes], dict[str, Any]]
    undecided: Sequence[str]
    unused: Sequence[tuple[str, str]] = ()

    def published_name(self, ours: str) -> str | None:
        """Return the published name of our parameter `ours`, or None."""
        names = (renamed(ours, *rule) for rule in self.renames.items())
        return next((name for name in names if name is not None), None)


def layout(
    name: str,
    read: Callable[[Shapes], dict[str, Any]],
    base: WeightLayout | None = None,
) -> WeightLayout:
    """Return the layout in NAME.toml. base: a layout whose renames hold where it has no others."""
    text = Path(__file__).with_name(f"{name}.toml").read_text(encoding="utf-8")
    fields = tomllib.loads(text)
    if base:
        fields["renames"] = {**base.renames, **fields["renames"]}
    return WeightLayout(read=read, **fields)


def layer_count(shapes: Shapes, prefix: str) -> int:
    """Return the number of layers stored as `prefix`N., which is the largest N plus one."""
    pattern = re.compile(re.escape(prefix) + r"(\d+)\.")
    # If a layer is missing from the file, a later step refuses the file.
    return max((int(match[1]) + 1 for name in shapes if (match := pattern.match(name))), default=0)


def size_at(shapes: Shapes, name: str, axis: int) -> int:
    """Return the size of an axis of a published parameter; raises LayoutError without it."""
    if name not in shapes:
        raise LayoutError(f"{name} is missing; its shape gives a size of the model")
    if not -len(shapes[name]) <= axis < len(shapes[name]):
        raise LayoutError(f"{name} has the shape {shapes[name]}, without axis {axis}")
    return shapes[name][axis]


def whole_ratio(size: int, unit: int, what: str) -> int:
    """Return size / unit; raises LayoutError about `what` if that is not a whole number."""
    if unit < 1 or size % unit or not size:
        raise LayoutError(f"{what}: {size} is no multiple of {unit}")
    return size // unit


def real_ratio(size: int, unit: int, what: str) -> float:
    """Return a ratio such that int(ratio * unit) is `size`; raises LayoutError without one."""
    if unit < 1 or not size:
        raise LayoutError(f"{what}: {size} is no multiple of {unit}")
    # A published width need not be a multiple; rounding down must give it back.
    ratio = size / unit
    return ratio if int(ratio * unit) == size else math.nextafter(ratio, math.inf)

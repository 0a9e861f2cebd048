"""Weights that other codebases publish: their names for our parameters, and recipes that fit."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from qgs.checkpoint.tensors import Shapes


class LayoutError(ValueError):
    """Published names and shapes that fit no recipe; the message says why."""


def renamed(name: str, ours: str, theirs: str) -> str | None:
    """`name` with `theirs` in place of `ours`; None if it has another one.

    `{}` stands for the number of a layer. An `ours` that ends with a dot is a module; what follows
    is the same on both sides.
    """
    # Only `{}` stands for something: the dots of a name are dots.
    pattern = re.escape(ours).replace(r"\{\}", r"(\d+)")
    match = re.match(pattern if ours.endswith(".") else pattern + "$", name)
    if match is None:
        return None
    return theirs.format(*match.groups()) + name[match.end() :]


@dataclass(frozen=True)
class WeightLayout:
    """Names and shapes in the state dicts of one published codebase.

    name: what the codebase calls its model. plugin: that whose components it has.
    source: where it is published.
    components: slot to the component types that the codebase has; other slots may hold any.
    renames: our to their names of modules and parameters, see `renamed`; the first that applies to
        a name counts.
    marks: published names by which this layout is recognised; a file of it has them all.
    unused: pairs of a published name and that of a parameter stored with it, which their code
        ignores.
    read: names and shapes of a whole state dict to a recipe that fits, a mapping with `recipe: 1`;
        raises LayoutError.
    undecided: text: what names and shapes leave open, and that `read` chooses the published value.
    """

    name: str
    plugin: str
    source: str
    components: Mapping[str, tuple[str, ...]]
    renames: Mapping[str, str]
    marks: tuple[str, ...]
    read: Callable[[Shapes], dict[str, Any]]
    unused: tuple[tuple[str, str], ...] = ()
    undecided: tuple[str, ...] = ()

    def published_name(self, ours: str) -> str | None:
        """The published name of our parameter `ours`; None where the codebase has none."""
        names = (renamed(ours, *rule) for rule in self.renames.items())
        return next((name for name in names if name is not None), None)


def layer_count(shapes: Shapes, prefix: str) -> int:
    """Number of layers stored as `prefix`N.: the largest N plus one."""
    pattern = re.compile(re.escape(prefix) + r"(\d+)\.")
    # Layers may be missing from a file: it is then refused for what is missing.
    return max((int(match[1]) + 1 for name in shapes if (match := pattern.match(name))), default=0)


def size_at(shapes: Shapes, name: str, axis: int) -> int:
    """Size of an axis of a published parameter; raises LayoutError if there is none."""
    if name not in shapes:
        raise LayoutError(f"{name} is missing, from which a size would be read off")
    if not -len(shapes[name]) <= axis < len(shapes[name]):
        raise LayoutError(f"{name} has the shape {shapes[name]}, from which no size can be read")
    return shapes[name][axis]


def whole_ratio(size: int, unit: int, what: str) -> int:
    """size / unit; raises LayoutError about `what` if that is no whole number."""
    if unit < 1 or size % unit or not size:
        raise LayoutError(f"{what}: {size} is no multiple of {unit}")
    return size // unit


def real_ratio(size: int, unit: int, what: str) -> float:
    """A ratio such that int(ratio * unit) is `size`; raises LayoutError if there is none."""
    if unit < 1 or not size:
        raise LayoutError(f"{what}: {size} is no multiple of {unit}")
    # A published width need not be a multiple; rounding down must give it back.
    ratio = size / unit
    return ratio if int(ratio * unit) == size else math.nextafter(ratio, math.inf)

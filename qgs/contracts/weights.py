"""Published weight layouts: how another codebase names what a model of ours has learned."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

Shapes: TypeAlias = Mapping[str, tuple[int, ...]]
"""Published parameter name to shape."""


class LayoutError(ValueError):
    """Published names and shapes that no recipe stands for; the message says why."""


@dataclass(frozen=True)
class Rename:
    """One module or parameter under both names; `{}` stands for a layer's number.

    Names that end with a dot are modules: what follows the dot is the same on both sides.
    """

    ours: str
    theirs: str

    def renamed(self, ours: str) -> str | None:
        """The published name of `ours`; None for a name that this rename does not cover."""
        pattern = re.escape(self.ours).replace(r"\{\}", r"(\d+)")
        match = re.match(pattern if self.ours.endswith(".") else pattern + "$", ours)
        if match is None:
            return None
        return self.theirs.format(*match.groups()) + ours[match.end() :]


@dataclass(frozen=True)
class Unused:
    """A published parameter that nothing reads, beside one that is read; both with `{}`."""

    theirs: str
    beside: str


@dataclass(frozen=True)
class WeightLayout:
    """The state dict of one published codebase.

    name: what the codebase calls its model. source: where it is published.
    components: slot to the component types whose parameters it has names for; slots without
        parameters may name the types that the codebase knows.
    renames: the first that covers a name applies.
    unused: what the codebase stores and never reads.
    marks: published names that files of this layout have and files of others lack.
    read: names and shapes of a whole state dict to the recipe that fits, a plain mapping with
        `recipe: 1`; raises LayoutError. What shapes leave open is as in the published model.
    legible: dotted paths of the options that `read` takes from names and shapes.
    undecided: what shapes leave open, in words, with the choice that `read` makes.
    """

    name: str
    source: str
    components: Mapping[str, tuple[str, ...]]
    renames: tuple[Rename, ...]
    marks: tuple[str, ...]
    read: Callable[[Shapes], dict[str, Any]]
    legible: tuple[str, ...]
    unused: tuple[Unused, ...] = ()
    undecided: tuple[str, ...] = ()

    def published_name(self, ours: str) -> str | None:
        """The published name of our parameter `ours`; None where the codebase has none."""
        return next((name for r in self.renames if (name := r.renamed(ours)) is not None), None)

    def unused_names(self, theirs: Iterable[str]) -> list[str]:
        """Published parameters that are stored beside `theirs` and never read."""
        rules = [Rename(unused.beside, unused.theirs) for unused in self.unused]
        return [name for key in theirs for rule in rules if (name := rule.renamed(key)) is not None]

    def marks_all_in(self, names: Iterable[str]) -> bool:
        """Whether a state dict with these published names is of this layout."""
        return set(self.marks) <= set(names)


def layer_count(shapes: Shapes, prefix: str) -> int:
    """How many layers are stored as `prefix`N.: one more than the largest N, 0 for none."""
    pattern = re.compile(re.escape(prefix) + r"(\d+)\.")
    return max((int(match[1]) + 1 for name in shapes if (match := pattern.match(name))), default=0)


def size_at(shapes: Shapes, name: str, axis: int) -> int:
    """One side of a published parameter; raises LayoutError when it is missing or flatter."""
    if name not in shapes:
        raise LayoutError(f"{name} is missing, from which a size would be read off")
    if not -len(shapes[name]) <= axis < len(shapes[name]):
        raise LayoutError(f"{name} has the shape {shapes[name]}, from which no size can be read")
    return shapes[name][axis]


def whole_ratio(size: int, unit: int, what: str) -> int:
    """size / unit; raises LayoutError, about `what`, where that is no whole number."""
    if unit < 1 or size % unit or not size:
        raise LayoutError(f"{what}: {size} is no multiple of {unit}")
    return size // unit


def real_ratio(size: int, unit: int, what: str) -> float:
    """The ratio of which int(ratio * unit) is `size`; raises LayoutError where there is none."""
    if unit < 1 or not size:
        raise LayoutError(f"{what}: {size} is no multiple of {unit}")
    ratio = size / unit
    return ratio if int(ratio * unit) == size else math.nextafter(ratio, math.inf)

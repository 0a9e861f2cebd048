"""Description of published weights of another codebase: parameter names, and fitting recipes."""

import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qgs.checkpoint.tensors import Shapes

Tree = dict[str, Any]
"""Recipe, or a part of it, as a plain mapping."""


class LayoutError(ValueError):
    """Error for published weights that fit no recipe."""


def renamed(name: str, ours: str, theirs: str) -> str | None:
    """Translate a parameter name by the rule `ours` -> `theirs`; None if the rule does not match.

    `{}` in a rule stands for the number of a layer. If `ours` ends with a dot, it names a module,
    and the rest of the name is kept.
    """
    # Only `{}` is a placeholder: dots in a name are plain dots.
    pattern = re.escape(ours).replace(r"\{\}", r"(\d+)")
    match = re.match(pattern if ours.endswith(".") else pattern + "$", name)
    if match is None:
        return None
    return theirs.format(*match.groups()) + name[match.end() :]


@dataclass(frozen=True)
class WeightLayout:
    """Parameter names and shapes in the state dicts of one published codebase.

    name: name of the published model. plugin: qgs plugin with the model's components.
    source: where the weights are published.
    components: component types that the codebase has, by slot of the model, such as `encoder`. A
        slot that is not listed may hold any component.
    renames: rules from names in qgs to published names, see `renamed`. The first rule that matches
        is used.
    marks: published names that identify this codebase. Every file of its weights has all of them.
    unused: rules from the published name of a parameter to the name of a further tensor. Files may
        hold this tensor, but the published code ignores it.
    read: function that takes names and shapes of a state dict and returns a recipe that fits, as a
        plain mapping. It raises LayoutError if none fits.
    undecided: texts about options that names and shapes do not determine, with the published value
        that `read` chooses.
    """

    name: str
    plugin: str
    source: str
    components: Mapping[str, Sequence[str]]
    renames: Mapping[str, str]
    marks: Sequence[str]
    read: Callable[[Shapes], Tree]
    undecided: Sequence[str]
    unused: Sequence[tuple[str, str]] = ()

    def published_name(self, ours: str) -> str | None:
        """Return the published name of the parameter that qgs calls `ours`, or None."""
        names = (renamed(ours, *rule) for rule in self.renames.items())
        return next(filter(None, names), None)


def layout(
    name: str, read: Callable[[Shapes], Tree], base: WeightLayout | None = None
) -> WeightLayout:
    """Load the layout in `name`.toml.

    read: function that returns a recipe for the names and shapes of a state dict. base: layout from
    which missing entries of `renames` are taken.
    """
    text = Path(__file__).with_name(f"{name}.toml").read_text(encoding="utf-8")
    fields = tomllib.loads(text)
    if base:
        fields["renames"] = {**base.renames, **fields["renames"]}
    return WeightLayout(read=read, **fields)


def layer_count(shapes: Shapes, prefix: str) -> int:
    """Return the number of layers whose parameter names start with `prefix` and a layer number."""
    pattern = re.compile(re.escape(prefix) + r"(\d+)\.")
    # If a layer is missing from the file, a later step refuses the file.
    return max((int(match[1]) + 1 for name in shapes if (match := pattern.match(name))), default=0)


def size_at(shapes: Shapes, name: str, axis: int = 0) -> int:
    """Return the size of an axis of a published parameter, by default of its first axis.

    Raises LayoutError if the parameter or the axis is missing.
    """
    if name not in shapes:
        raise LayoutError(f"the weight {name} is missing; its shape determines a size of the model")
    if not -len(shapes[name]) <= axis < len(shapes[name]):
        raise LayoutError(f"the weight {name} has the shape {shapes[name]}, without axis {axis}")
    return shapes[name][axis]


def whole_ratio(size: int, unit: int, what: str) -> int:
    """Return size / unit; raise LayoutError if it is no integer. what: name of `size`."""
    if unit < 1 or size % unit or not size:
        raise LayoutError(f"{what}: {size} must be a multiple of {unit}, and not 0")
    return size // unit


def real_ratio(size: int, unit: int, what: str) -> float:
    """Return a ratio such that int(ratio * unit) equals `size`.

    what: name of `size`, for messages. Raises LayoutError if `size` or `unit` is 0.
    """
    if unit < 1 or not size:
        raise LayoutError(f"{what}: {size} and {unit} have no ratio, since one of them is 0")
    # A published width need not be a multiple; rounding down must give it back.
    ratio = size / unit
    return ratio if int(ratio * unit) == size else math.nextafter(ratio, math.inf)

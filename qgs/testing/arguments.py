"""Refusing what is no argument of a case or of a check, with what to write instead."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from torch import Tensor

from qgs.composer.errors import did_you_mean
from qgs.contracts import ModelDims
from qgs.testing.wording import named


def refuse_other_dims(dims: Any) -> None:
    """Raise TypeError for what is no ModelDims, ValueError for sizes that no model has."""
    if not isinstance(dims, ModelDims):
        raise TypeError(f"dims is {named(dims)}; write dims=ModelDims(width=32, heads=2, depth=2)")
    sizes = (dims.width, dims.heads, dims.depth)
    if not all(_is_count(size) for size in sizes) or dims.width % dims.heads:
        raise ValueError(
            f"dims is {dims}; a model has a width that its heads divide, and some depth, such as "
            "ModelDims(width=32, heads=2, depth=2)"
        )


def refuse_other_size(size: Any) -> None:
    """Raise TypeError for what is neither None nor an (H, W) in pixels."""
    pair = isinstance(size, tuple) and len(size) == 2 and all(_is_count(side) for side in size)
    if size is not None and not pair:
        raise TypeError(f"image_size is {named(size)}; write (H, W) in pixels, such as (32, 48)")


def refuse_other_makers(given: Any, known: Collection[str]) -> None:
    """Raise TypeError for what is no mapping of fields to functions, ValueError for other fields.

    known: names of the fields that the component reads or writes.
    """
    if not isinstance(given, Mapping):
        raise TypeError(f"fields is {named(given)}; write {{name: function}}")
    for name, function in given.items():
        if not callable(function):
            raise TypeError(
                f"fields[{name!r}] is {named(function)}; write a function that makes a valid "
                "field of normally distributed numbers"
            )
        if name not in known:
            raise ValueError(
                f"fields names {name!r}, which this component neither requires nor provides; "
                f"{did_you_mean(str(name), known, 'fields')}"
            )


def refuse_other_shapes(given: Any) -> None:
    """Raise TypeError for what is neither None nor a mapping of names to shapes."""
    if given is None:
        return
    fix = "write {name: shape}, such as {'norm.weight': (32,)}"
    if not isinstance(given, Mapping):
        raise TypeError(f"state_dict is {named(given)}; {fix}")
    for name, shape in given.items():
        if isinstance(shape, Tensor):
            raise TypeError(
                f"state_dict holds the tensor {name!r} and not its shape; write "
                "{name: tuple(x.shape) for name, x in module.state_dict().items()}"
            )
        sizes = isinstance(shape, Sequence) and all(isinstance(size, int) for size in shape)
        if not sizes or isinstance(shape, str):
            raise TypeError(f"state_dict[{name!r}] is {named(shape)}; {fix}")


def _is_count(size: Any) -> bool:
    return isinstance(size, int) and not isinstance(size, bool) and size > 0

"""In what two state dicts, or two recipes, differ: the lines that messages list."""

import os
import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any
from zlib import crc32

import torch
from torch import Tensor

from qgs.composer.recipe import flat
from qgs.composer.yaml_text import inline
from qgs.contracts.weights import Shapes
from qgs.io.metadata import damaged
from qgs.wording import listed

CONTENTS = "qgs.contents"
"""Key of the metadata that tell the tensors of a file."""

_WITHOUT_EFFECT_ON_TRAINED = re.compile(
    r"(\b|_)(init|std|layer_scale)(\b|_)|^model\.(supervision|renderer)\."
)
"""Options that do not change what a model with given weights predicts."""


def shapes_of(tensors: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Names to shapes."""
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


def nonfinite(tensors: Iterable[tuple[str, Tensor]]) -> list[str]:
    """Names of those of the named `tensors` that hold NaN or infinity."""
    return [name for name, tensor in tensors if not bool(tensor.isfinite().all())]


def refuse_broken(tensors: Mapping[str, Tensor], origin: object) -> None:
    """Raise ValueError when `tensors`, weights read from `origin`, hold NaN or infinity."""
    if broken := nonfinite(tensors.items()):
        fix = "its training had diverged, or the file is damaged: take another"
        raise ValueError(f"{origin}: weights are not finite: {listed(broken)}; {fix}")


def contents(tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """What tells tensors on the CPU from others: types, shapes, checksums of their bytes."""
    sums = {n: crc32(t.reshape(-1).view(torch.uint8).numpy().data) for n, t in tensors.items()}
    return {n: f"{t.dtype} {list(t.shape)} crc32 {sums[n]:08x}" for n, t in tensors.items()}


def refuse_changed(
    tensors: Mapping[str, Tensor], written: Mapping[str, Any], path: str | os.PathLike[str]
) -> None:
    """Raise CheckpointError unless the `contents` of `tensors`, read from `path`, are `written`."""
    found = contents(tensors)
    differing = [
        f"{name[:200]}: {found.get(name, 'absent')} instead of {str(written.get(name))[:200]}"
        for name in dict.fromkeys([*written, *found])
        if found.get(name) != written.get(name)
    ]
    if differing:
        raise damaged(path, f"not the tensors that were written: {listed(differing, between='; ')}")


def differing_tensors(file: Shapes, recipe: Shapes, unused: Collection[str] = ()) -> list[str]:
    """Names and shapes in which a file and the model of a recipe differ, one line each.

    unused: names that the file may hold besides.
    """
    found = [f"missing: {name}" for name in recipe if name not in file]
    found += [f"unexpected: {name}" for name in file if name not in recipe and name not in unused]
    return found + [
        f"shape of {name}: {file[name]} in the file, {shape} in the recipe"
        for name, shape in recipe.items()
        if name in file and file[name] != shape
    ]


def differing_types(
    file: Mapping[str, Tensor], recipe: Mapping[str, Tensor], widened: bool = False
) -> list[str]:
    """The types of numbers in which tensors of both differ, one line each.

    widened: a file may hold half precision where the recipe has float32.
    """
    alike = {(torch.float16, torch.float32), (torch.bfloat16, torch.float32)} if widened else ()
    return [
        f"type of {name}: {file[name].dtype} in the file, {tensor.dtype} in the recipe"
        for name, tensor in recipe.items()
        if name in file and file[name].dtype != tensor.dtype
        if (file[name].dtype, tensor.dtype) not in alike
    ]


def differing_options(
    a: Mapping[str, Any], b: Mapping[str, Any]
) -> dict[str, tuple[str | None, str | None]]:
    """Dotted path to the values in the recipes `a` and `b`, as YAML, where these are not the same.

    None stands for an option that a recipe does not have.
    """
    of_a, of_b, absent = flat(a), flat(b), object()
    return {
        path: (
            inline(of_a[path]) if path in of_a else None,
            inline(of_b[path]) if path in of_b else None,
        )
        for path in of_a | of_b
        if of_a.get(path, absent) != of_b.get(path, absent)
    }


def options_beside_weights(
    a: Mapping[str, Any], b: Mapping[str, Any]
) -> dict[str, tuple[str, str]]:
    """`differing_options` that decide what a model with given weights predicts, "none" for None.

    Initial values, supervision and the renderer do not.
    """
    return {
        path: (ours or "none", theirs or "none")
        for path, (ours, theirs) in differing_options(a, b).items()
        if path.startswith("model.") and not _WITHOUT_EFFECT_ON_TRAINED.search(path)
    }

"""In what two state dicts, or two recipes, differ: the lines that messages list."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any

from torch import Tensor

from qgs.composer.recipe import flat
from qgs.composer.yaml_text import dump
from qgs.contracts.weights import Shapes

ABSENT = "none"


"""Stands for the value of an option that a recipe does not have."""


_INITIAL = re.compile(r"(\b|_)(init|std|layer_scale)(\b|_)")


_ELSEWHERE = re.compile(r"^model\.(supervision|renderer)\.")


def shapes_of(tensors: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Names to shapes."""
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


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


def differing_options(
    a: Mapping[str, Any], b: Mapping[str, Any]
) -> dict[str, tuple[str | None, str | None]]:
    """Dotted path to the values in the recipes `a` and `b`, as YAML, where these are not the same.

    None stands for an option that a recipe does not have.
    """
    of_a, of_b = flat(a), flat(b)
    return {
        path: (_word(of_a, path), _word(of_b, path))
        for path in dict.fromkeys([*of_a, *of_b])
        if path not in of_a or path not in of_b or of_a[path] != of_b[path]
    }


def options_beside_weights(
    a: Mapping[str, Any], b: Mapping[str, Any]
) -> dict[str, tuple[str, str]]:
    """`differing_options` that decide what a model with given weights predicts.

    Initial values, supervision and the renderer do not.
    """
    return {
        path: (ours or ABSENT, theirs or ABSENT)
        for path, (ours, theirs) in differing_options(a, b).items()
        if path.startswith("model.") and not (_INITIAL.search(path) or _ELSEWHERE.search(path))
    }


def _word(options: Mapping[str, Any], path: str) -> str | None:
    if path not in options:
        return None
    return dump(options[path], flow=True).removesuffix("\n").removesuffix("\n...")

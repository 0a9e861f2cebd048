"""Inputs and outputs of components as trees of tensors with dotted names."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from qgs.containers import map_tensors, named_tensors


def leaves(tree: Any) -> dict[str, Tensor]:
    """Every tensor of `tree` by its dotted name; a single tensor is called `output`."""
    return {name or "output": tensor for name, tensor in named_tensors(tree)}


def mapped(tree: Any, function: Callable[[str, Tensor], Tensor]) -> Any:
    """`tree` with `function(name, tensor)` in place of every tensor."""
    names = iter(leaves(tree))
    return map_tensors(lambda tensor: function(next(names), tensor), tree)


def floating(tree: Any) -> dict[str, Tensor]:
    """Every floating-point tensor by its dotted name."""
    return {name: tensor for name, tensor in leaves(tree).items() if tensor.is_floating_point()}


def cloned(tree: Any) -> Any:
    """A copy that shares no memory and belongs to no autograd graph."""
    return map_tensors(lambda x: x.detach().clone(), tree)


def tracked(tree: Any) -> Any:
    """A copy whose floating-point tensors require gradients."""
    return map_tensors(lambda x: x.detach().clone().requires_grad_(x.is_floating_point()), tree)


def cast(tree: Any, dtype: torch.dtype) -> Any:
    """`tree` with its floating-point tensors in `dtype`."""
    return map_tensors(lambda x: x.to(dtype) if x.is_floating_point() else x, tree)


def scalar(tree: Any) -> Tensor:
    """A float64 sum of all floating-point numbers in `tree`, with random weights."""
    total = torch.zeros((), dtype=torch.float64)
    for index, tensor in enumerate(floating(tree).values()):
        generator = torch.Generator().manual_seed(index)
        weights = torch.randn(tensor.shape, generator=generator, dtype=torch.float64)
        total = total + (tensor.double().cpu() * weights).sum()
    return total


def gradients(total: Tensor, tree: Any) -> dict[str, Tensor]:
    """The gradient of `total` in every tensor of `tree` that it depends on."""
    if not total.requires_grad:
        return {}
    given = {name: tensor for name, tensor in floating(tree).items() if tensor.requires_grad}
    found = torch.autograd.grad(total, list(given.values()), allow_unused=True)
    return {name: x for name, x in zip(given, found, strict=True) if x is not None}


def difference(one: Any, other: Any, rtol: float = 0.0, atol: float = 0.0) -> str:
    """The first tensor in which two trees differ beyond the tolerances; "" if there is none.

    Without tolerances the dtypes must agree too.
    """
    ours, theirs = leaves(one), leaves(other)
    if ours.keys() != theirs.keys():
        return f"{sorted(ours)} against {sorted(theirs)}"
    for name, tensor in ours.items():
        seen = theirs[name]
        if tensor.shape != seen.shape or (not atol and tensor.dtype != seen.dtype):
            return f"{name}: {described(tensor)} against {described(seen)}"
        seen = seen.to(tensor)
        if not torch.allclose(tensor, seen, rtol=rtol, atol=atol, equal_nan=True):
            off = (tensor.double() - seen.double()).abs().max().item()
            return f"{name}: values differ by up to {off:.3g}"
    return ""


def described(tensor: Tensor) -> str:
    """Shape and dtype, such as `2x6x3 float32`."""
    shape = "x".join(map(str, tensor.shape)) or "scalar"
    return f"{shape} {str(tensor.dtype).removeprefix('torch.')}"


def not_finite(tree: Any) -> list[str]:
    """Names of the tensors that hold a NaN or an infinity."""
    return [name for name, tensor in floating(tree).items() if not tensor.isfinite().all()]

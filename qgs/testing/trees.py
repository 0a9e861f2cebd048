"""Inputs and outputs of components as trees of tensors with dotted names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from hashlib import sha256
from typing import Any

import torch
from torch import Tensor

Visit = Callable[[str, Tensor], Any]


def mapped(tree: Any, visit: Visit, name: str = "") -> Any:
    """`tree` with every tensor replaced by `visit(name, tensor)`; other values stay."""

    def below(key: str, value: Any) -> Any:
        return mapped(value, visit, f"{name}.{key}" if name else key)

    if isinstance(tree, Tensor):
        return visit(name or "output", tree)
    if is_dataclass(tree) and not isinstance(tree, type):
        changed = {f.name: below(f.name, getattr(tree, f.name)) for f in fields(tree) if f.init}
        return replace(tree, **changed)
    if isinstance(tree, Mapping):
        return {key: below(str(key), value) for key, value in tree.items()}
    if isinstance(tree, tuple | list):
        return type(tree)(below(str(index), value) for index, value in enumerate(tree))
    return tree


def leaves(tree: Any) -> dict[str, Tensor]:
    """Every tensor of `tree` by its dotted name."""
    found: dict[str, Tensor] = {}

    def note(name: str, tensor: Tensor) -> Tensor:
        found[name] = tensor
        return tensor

    mapped(tree, note)
    return found


def floating(tree: Any) -> dict[str, Tensor]:
    """Every tensor of floating-point numbers."""
    return {name: tensor for name, tensor in leaves(tree).items() if tensor.is_floating_point()}


def cloned(tree: Any) -> Any:
    """A copy that shares no memory, outside of any graph."""
    return mapped(tree, lambda _, tensor: tensor.detach().clone())


def tracked(tree: Any) -> Any:
    """A copy whose floating-point tensors ask for gradients."""
    return mapped(
        tree,
        lambda _, x: x.detach().clone().requires_grad_(x.is_floating_point() or x.is_complex()),
    )


def cast(tree: Any, dtype: torch.dtype) -> Any:
    """A copy with floating-point tensors of `dtype`."""
    return mapped(tree, lambda _, x: x.to(dtype) if x.is_floating_point() else x)


def scalar(tree: Any) -> Tensor:
    """A sum of everything in `tree`, in float64, with weights that let nothing cancel."""
    total = torch.zeros((), dtype=torch.float64)
    for index, tensor in enumerate(floating(tree).values()):
        generator = torch.Generator().manual_seed(index)
        weights = torch.randn(tensor.shape, generator=generator, dtype=torch.float64)
        total = total + (tensor.double().cpu() * weights).sum()
    return total


def slopes(total: Tensor, tree: Any) -> dict[str, Tensor]:
    """The gradient of `total` in every tensor of `tree` that it has one in, by dotted name."""
    if not total.requires_grad:
        return {}
    given = {name: tensor for name, tensor in floating(tree).items() if tensor.requires_grad}
    found = torch.autograd.grad(total, list(given.values()), allow_unused=True)
    return {n: slope for n, slope in zip(given, found, strict=True) if slope is not None}


def difference(one: Any, other: Any) -> str:
    """The first tensor in which two trees differ by a bit; "" for equal ones."""
    ours, theirs = leaves(one), leaves(other)
    if ours.keys() != theirs.keys():
        return f"{sorted(ours)} against {sorted(theirs)}"
    for name, tensor in ours.items():
        seen = theirs[name]
        if tensor.shape != seen.shape or tensor.dtype != seen.dtype:
            return f"{name}: {described(tensor)} against {described(seen)}"
        if not torch.equal(tensor.nan_to_num(1.25e30), seen.nan_to_num(1.25e30)):
            return f"{name}: values differ by up to {(tensor - seen).abs().max().item():.3g}"
    return ""


def distance(one: Any, other: Any, rtol: float, atol: float) -> str:
    """The first tensor in which two trees differ beyond the tolerances; "" for close ones."""
    ours, theirs = leaves(one), leaves(other)
    if ours.keys() != theirs.keys():
        return f"{sorted(ours)} against {sorted(theirs)}"
    for name, tensor in ours.items():
        seen = theirs[name].to(tensor)
        if tensor.shape != seen.shape:
            return f"{name}: {described(tensor)} against {described(seen)}"
        if not torch.allclose(tensor, seen, rtol=rtol, atol=atol, equal_nan=True):
            return f"{name}: values differ by up to {(tensor - seen).abs().max().item():.3g}"
    return ""


def described(tensor: Tensor) -> str:
    """Shape and dtype in words."""
    shape = "x".join(map(str, tensor.shape)) or "scalar"
    return f"{shape} {str(tensor.dtype).removeprefix('torch.')}"


def digests(tree: Any) -> dict[str, str]:
    """A hash of the bits of every tensor."""
    found = leaves(tree).items()
    return {name: sha256(_bits(tensor)).hexdigest() for name, tensor in found}


def _bits(tensor: Tensor) -> bytes:
    return tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes()


def not_finite(tree: Any) -> list[str]:
    """Names of the tensors that hold a NaN or an infinity."""
    return [name for name, tensor in floating(tree).items() if not tensor.isfinite().all()]

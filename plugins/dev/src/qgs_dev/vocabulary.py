"""Helpers of the checks: trees of tensors, values in modules, trial runs, and assertions.

A tree is a nested structure of tensors, such as the inputs of a component. A tensor in a tree has a
dotted name, such as `state.features`.
"""

import inspect
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy
import torch
from torch import Tensor, nn
from torch.autograd.gradcheck import GradcheckError, gradcheck

from qgs.containers import map_tensors, named_tensors
from qgs.contracts import Renderer
from qgs_dev.case import Case, ContractError, seeded
from qgs_dev.inputs import USUAL, WITH_MEMORY, Inputs, Sizes, inputs_of


def leaves(tree: Any) -> dict[str, Tensor]:
    """Return all tensors of `tree` by dotted name; a single tensor is called `output`."""
    return {name or "output": tensor for name, tensor in named_tensors(tree)}


def mapped(tree: Any, function: Callable[[str, Tensor], Tensor]) -> Any:
    """Return a copy of `tree` with `function(name, tensor)` in place of each tensor."""
    names = iter(leaves(tree))
    return map_tensors(lambda tensor: function(next(names), tensor), tree)


def floating(tree: Any) -> dict[str, Tensor]:
    """Return all floating-point tensors of `tree` by dotted name."""
    return {name: tensor for name, tensor in leaves(tree).items() if tensor.is_floating_point()}


def cloned(tree: Any) -> Any:
    """Return a detached copy of `tree` that shares no memory with it."""
    return map_tensors(lambda x: x.detach().clone(), tree)


def tracked(tree: Any) -> Any:
    """Return a detached copy of `tree` whose floating-point tensors require gradients."""
    return map_tensors(lambda x: x.requires_grad_(x.is_floating_point()), cloned(tree))


def cast(tree: Any, dtype: torch.dtype) -> Any:
    """Return `tree` with floating-point tensors converted to `dtype`."""
    return map_tensors(lambda x: x.to(dtype) if x.is_floating_point() else x, tree)


def scene(tree: Any, index: int) -> Any:
    """Return a batch with only scene `index` of the batch `tree`."""
    return map_tensors(lambda x: x[index : index + 1], tree)


def masked(tree: Any, mask_BN: Tensor, other: Any) -> Any:
    """Return `tree` with values of the tree `other` for queries whose mask is False.

    Tensors have a value for each query, (B, N, ...), or for each Gaussian, (B, N * K, ...).
    """
    theirs = leaves(other)

    def kept(name: str, x: Tensor) -> Tensor:
        of_each = mask_BN.repeat_interleave(x.shape[1] // mask_BN.shape[1], 1)
        return x.where(of_each.view(*x.shape[:2], *[1] * (x.ndim - 2)), theirs[name])

    return mapped(tree, kept)


def scalar(tree: Any) -> Tensor:
    """Return a randomly weighted sum of all floating-point numbers in `tree`, in float64."""
    total = torch.zeros(()).double()
    for index, tensor in enumerate(floating(tree).values()):
        # Equal weights would let errors of opposite signs cancel.
        generator = torch.Generator().manual_seed(index)
        weights = torch.randn(tensor.shape, generator=generator, dtype=torch.float64)
        total = total + (tensor.double().cpu() * weights).sum()
    return total


def gradients(total: Tensor, tree: Any) -> dict[str, Tensor]:
    """Return the gradients of `total` for all tensors of `tree` that influence it, by name."""
    if not total.requires_grad:
        return {}
    given = {name: tensor for name, tensor in floating(tree).items() if tensor.requires_grad}
    found = torch.autograd.grad(total, list(given.values()), allow_unused=True)
    return {name: x for name, x in zip(given, found, strict=True) if x is not None}


def difference(one: Any, other: Any, rtol: float = 0.0, atol: float = 0.0) -> str:
    """Describe the first tensor in which two trees differ; return "" if they agree.

    Tensors may differ by the tolerances `rtol` and `atol`. If both are 0, dtypes must agree, too.
    """
    ours = leaves(one)
    theirs = leaves(other)
    if ours.keys() != theirs.keys():
        return f"{sorted(ours)} against {sorted(theirs)}"
    for name, tensor in ours.items():
        seen = theirs[name]
        if tensor.shape != seen.shape or (not atol and tensor.dtype != seen.dtype):
            return f"{name}: {described(tensor)} against {described(seen)}"
        # Trees may be on two devices or, with a tolerance, in two precisions.
        seen = seen.to(tensor)
        if not torch.allclose(tensor, seen, rtol=rtol, atol=atol, equal_nan=True):
            off = (tensor.double() - seen.double()).abs().max().item()
            return f"{name}: values differ by up to {off:.3g}"
    return ""


def described(tensor: Tensor) -> str:
    """Return shape and dtype of a tensor as text, for example `2x6x3 float32`."""
    shape = "x".join(map(str, tensor.shape)) or "scalar"
    return f"{shape} {str(tensor.dtype).removeprefix('torch.')}"


# Attributes in which torch stores parameters, buffers, submodules, hooks and the mode.
TORCH_OWN = frozenset(vars(nn.Module()))


def each_mode(module: Any) -> Iterator[str]:
    """Set `module` to evaluation, then to training mode; yield the name of each mode."""
    for mode in ("evaluation", "training"):
        module.train(mode == "training")
        yield mode


def tensors_of(module: nn.Module) -> dict[str, Tensor]:
    """Return all parameters and buffers by name, including buffers that are not saved."""
    return dict(module.named_parameters()) | dict(module.named_buffers())


def attributes(module: nn.Module) -> dict[str, Any]:
    """Return a module's attributes, as copies that can be compared with later ones.

    The result includes attributes of submodules, and of the classes of all these modules. It leaves
    out parameters, buffers, submodules and values of a `cached_property`.
    """
    found = {}
    for name, part in module.named_modules():
        for key, value in vars(part).items():
            # A cached property depends on the module alone.
            kept = isinstance(getattr(type(part), key, None), cached_property)
            if key not in TORCH_OWN and not kept:
                found[f"{name}.{key}".lstrip(".")] = _comparable(value)
        for owner in type(part).__mro__:
            # Classes can have state too, such as a cache that all instances share.
            if owner.__module__.partition(".")[0] in ("torch", "builtins", "abc", "typing"):
                continue
            for key, value in vars(owner).items():
                if not key.startswith(("__", "_abc_")) and not _is_code(value):
                    found[f"{owner.__name__}.{key}"] = _comparable(value)
    return found


def _is_code(value: Any) -> bool:
    """Return True for a function, a class, or a descriptor such as a property."""
    return inspect.isroutine(value) or inspect.isclass(value) or hasattr(value, "__get__")


def _comparable(value: Any, inside: tuple[int, ...] = ()) -> Any:
    """Return a copy of `value` that can be compared with a later copy.

    inside: ids of the containers around `value`. A container inside itself becomes None.
    """
    # A module may hold an object that holds the module.
    if id(value) in inside:
        return None
    inside = (*inside, id(value))
    if isinstance(value, Tensor):
        # Bytes, since a NaN does not equal itself.
        data = value.detach().cpu().contiguous().flatten().view(torch.uint8)
        return str(value.dtype), tuple(value.shape), data.numpy().tobytes()
    if isinstance(value, numpy.ndarray):
        return value.tobytes()
    if isinstance(value, Mapping):
        return {repr(key): _comparable(item, inside) for key, item in value.items()}
    if isinstance(value, list | tuple | deque):
        return [_comparable(item, inside) for item in value]
    if isinstance(value, set | frozenset):
        return sorted(map(repr, value))
    if hasattr(value, "__dict__") and not _is_code(value):
        return type(value), _comparable(vars(value), inside)
    return repr(value)


class Trial:
    """Component of a case, with noise added to all parameters, and random inputs for it."""

    def __init__(self, case: Case, sizes: Sizes = USUAL, seed: int = 0) -> None:
        self.case = case
        self.module = case.lively()
        self.inputs = inputs_of(case, sizes, seed)

    def __call__(self, inputs: Inputs | None = None, **replaced: Any) -> Any:
        """Return the outputs of the component for `inputs`, by default `self.inputs`.

        replaced: values that replace inputs of the same names.
        """
        return self.module(*{**(inputs or self.inputs), **replaced}.values())

    def in_each_mode(self, inputs: Inputs | None = None) -> Iterator[tuple[str, Any]]:
        """Yield (mode, outputs) in evaluation, then in training, with the same random seed."""
        for mode in each_mode(self.module):
            # The seed holds for this pass only: the caller keeps its own random state.
            with seeded(0):
                outputs = self(inputs)
            yield mode, outputs

    def tracked(self, inputs: Inputs | None = None) -> Inputs:
        """Return copies of `inputs`, by default of `self.inputs`, whose tensors require gradients.

        Exception: camera tensors that a renderer does not list in `camera_gradients` require none.
        """
        component = self.case.component
        fixed: set[str] = set()
        if issubclass(component, Renderer):
            fixed = {"c2w", "intrinsics"} - {*component.camera_gradients}
        return mapped(
            tracked(inputs or self.inputs),
            lambda name, x: x.detach() if name.removeprefix("cameras.") in fixed else x,
        )

    def state_of(self, outputs: Any) -> Any:
        """Return the query state if `outputs` are of a layer or feedback, otherwise `outputs`."""
        return outputs[0] if self.case.slot in WITH_MEMORY else outputs


def expect(holds: Any, seen: str) -> None:
    """Raise ContractError with the message `seen` unless `holds` is true."""
    if not holds:
        raise ContractError(seen)


def expect_none(names: Iterable[Any], fault: str) -> None:
    """Raise ContractError with the names and their common `fault`, if there are any names."""
    found = sorted(map(str, names))
    expect(not found, f"{', '.join(found)}: {fault}")


def expect_same(one: Any, other: Any, where: str, rtol: float = 0.0, atol: float = 0.0) -> None:
    """Raise ContractError if two trees differ by more than the tolerances `rtol` and `atol`.

    If both are 0, dtypes must agree, too. where: start of the message.
    """
    found = difference(one, other, rtol, atol)
    expect(not found, f"{where}, {found}")


def expect_finite(tree: Any, where: str) -> None:
    """Raise ContractError if a tensor of `tree` contains NaN or infinity.

    where: end of the error message.
    """
    broken = [name for name, tensor in floating(tree).items() if not tensor.isfinite().all()]
    expect_none(broken, f"not finite {where}")


def expect_inside(x: Tensor, low: float, high: float, what: str) -> None:
    """Raise ContractError unless all numbers of `x` are in [low, high]. what: name of `x`."""
    least, most = x.aminmax()
    expect(least >= low and most <= high, f"{what} are {least:.4g} to {most:.4g}")


def expect_right_gradient(
    value: Callable[..., Tensor], points: Any, where: str, **tolerances: Any
) -> None:
    """Raise ContractError if the gradient of `value` at `points` does not match finite differences.

    value: function to check. where: start of the error message. tolerances: options of gradcheck.
    """
    try:
        gradcheck(value, points, **tolerances)
    except GradcheckError as error:
        expect(False, f"{where}: {' '.join(str(error).split())}"[:400])

"""Holding out what learned layers compute, so that the rest of a component can be looked at."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

LAYERS = {
    "linear",
    "bilinear",
    "conv1d",
    "conv2d",
    "conv3d",
    "layer_norm",
    "rms_norm",
    "group_norm",
    "multi_head_attention_forward",
    "scaled_dot_product_attention",
}
"""Functions of torch that are layers of a network, if anything in them is learned."""

PRODUCTS = {"matmul", "__matmul__", "__rmatmul__", "mm", "mv", "bmm", "addmm", "baddbmm", "einsum"}
"""Functions of torch that are as often geometry: a rotation of points is one."""


class LearnedLayers(TorchFunctionMode):
    """Keeps in `outputs`, in their order, what learned layers give while it is entered.

    A product belongs to the layers if all its factors are learned, which is to say that they
    require gradients: parameters, features, and what is made of them.
    """

    def __init__(self) -> None:
        super().__init__()
        self.outputs: list[Any] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call `func` and keep what it gives."""
        given = func(*args, **(kwargs or {}))
        if _is_learned(func, tree_leaves((args, kwargs))):
            self.outputs.append(tree_map(_copied, given))
        return given


class ReplayedLayers(TorchFunctionMode):
    """Learned layers give `outputs`, in their order and raised to float32, while it is entered."""

    def __init__(self, outputs: Iterable[Any]) -> None:
        super().__init__()
        self._outputs = iter(outputs)

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call `func`, but for a layer."""
        layer = _is_learned(func, tree_leaves((args, kwargs)))
        given = next(self._outputs, None) if layer else None
        return func(*args, **(kwargs or {})) if given is None else tree_map(_raised, given)


def _copied(value: Any) -> Any:
    return value.clone() if isinstance(value, Tensor) else value


def _raised(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) else value


def _is_learned(func: Any, operands: list[Any]) -> bool:
    name = getattr(func, "__name__", "")
    learned = [x.requires_grad for x in operands if isinstance(x, Tensor)]
    return (name in LAYERS and any(learned)) or (name in PRODUCTS and all(learned))

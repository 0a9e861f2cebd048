"""Holding out what learned layers compute, so that the rest of a component can be looked at."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
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
    "gru",
    "lstm",
    "gru_cell",
    "lstm_cell",
    "rnn_tanh_cell",
    "rnn_relu_cell",
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
        self.outputs: list[tuple[str, Any]] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call `func` and keep what it gives."""
        given = func(*args, **(kwargs or {}))
        if _is_learned(func, tree_leaves((args, kwargs))):
            self.outputs.append((func.__name__, tree_map(_copied, given)))
        return given


class ReplayedLayers(TorchFunctionMode):
    """Learned layers give `outputs`, in their order and raised to float32, while it is entered.

    differs: whether other layers were called than those that gave the outputs; from the first such
    one on, layers give what they compute.
    """

    def __init__(self, outputs: Sequence[tuple[str, Any]]) -> None:
        super().__init__()
        self._left = deque(outputs)
        self.differs = False

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call `func`, and give what it gave before if it is a layer."""
        given = func(*args, **(kwargs or {}))
        if self.differs or not _is_learned(func, tree_leaves((args, kwargs))):
            return given
        name, before = self._left.popleft() if self._left else ("", None)
        self.differs = name != func.__name__ or _shapes(before) != _shapes(given)
        return given if self.differs else tree_map(_raised, before)


class HalvedProducts(TorchFunctionMode):
    """Keeps in `names` what multiplies float32 tensors, none of them learned, to half ones."""

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call `func` and note whether autocast took geometry to half precision."""
        given = func(*args, **(kwargs or {}))
        name = getattr(func, "__name__", "")
        if name in PRODUCTS and given.dtype == torch.bfloat16:
            factors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
            if all(x.dtype == torch.float32 and not _is_made_of_learned(x) for x in factors):
                self.names.add(name)
        return given


def _is_made_of_learned(tensor: Tensor) -> bool:
    return tensor.requires_grad or isinstance(tensor, nn.Parameter)


def _shapes(value: Any) -> list[Any]:
    return [x.shape for x in tree_leaves(value) if isinstance(x, Tensor)]


def _copied(value: Any) -> Any:
    return value.clone() if isinstance(value, Tensor) else value


def _raised(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) else value


def _is_learned(func: Any, operands: list[Any]) -> bool:
    name = getattr(func, "__name__", "")
    learned = [x.requires_grad for x in operands if isinstance(x, Tensor)]
    return (name in LAYERS and any(learned)) or (name in PRODUCTS and all(learned))

"""Tensors that note when their numbers are read."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from qgs.testing.trees import leaves, mapped

METADATA = {
    getattr(Tensor, name).__get__
    for name in (
        "shape",
        "dtype",
        "device",
        "ndim",
        "requires_grad",
        "layout",
        "is_cuda",
        "grad_fn",
    )
} | {Tensor.size, Tensor.dim, Tensor.numel, Tensor.__len__, Tensor.is_floating_point}
"""What can be asked of a tensor without reading a number of it."""


class RecordedTensor(Tensor):
    """A tensor that adds `read_as` to `readers` as soon as anything is computed of it."""

    read_as: str
    readers: set[str]

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Note the read; results are plain tensors."""
        read = func not in METADATA

        def plain(value: Any) -> Any:
            if not isinstance(value, RecordedTensor):
                return value
            if read:
                value.readers.add(value.read_as)
            with torch._C.DisableTorchFunctionSubclass():
                return value.as_subclass(Tensor)

        return func(*tree_map(plain, args), **tree_map(plain, kwargs or {}))


def recorded(tree: Any) -> tuple[Any, set[str]]:
    """A copy of `tree` and the names of the tensors in it that were read so far."""
    read: set[str] = set()

    def wrap(name: str, tensor: Tensor) -> Tensor:
        note = tensor.detach().clone().as_subclass(RecordedTensor)
        note.read_as, note.readers = name, read
        return note

    copy = mapped(tree, wrap)
    leaves(copy)
    read.clear()
    return copy, read

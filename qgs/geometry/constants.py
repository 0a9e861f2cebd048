"""Constant tensors, created on their device."""

from collections.abc import Sequence

import torch
from torch import Tensor


def constant(values: Sequence[float], like: Tensor) -> Tensor:
    """Return `values` (N,) in the dtype and on the device of `like`, without waiting for a copy."""
    return torch.stack([like.new_full((), value) for value in values])

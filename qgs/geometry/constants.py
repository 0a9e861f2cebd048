"""Constant tensors, created directly on the device that uses them."""

from collections.abc import Sequence

import torch
from torch import Tensor


def constant(values: Sequence[float], like: Tensor) -> Tensor:
    """Return `values` (N,) as a tensor with the dtype and device of `like`.

    The CPU does not wait for a copy to the device.
    """
    return torch.stack([like.new_full((), value) for value in values])

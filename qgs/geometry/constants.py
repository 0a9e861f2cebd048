"""Fixed numbers as tensors, made on their device."""

from collections.abc import Sequence

import torch
from torch import Tensor


def constant(values: Sequence[float], like: Tensor) -> Tensor:
    """`values` (N,) in the dtype and on the device of `like`.

    Each number is filled in there, for `torch.tensor` copies from the host, and a copy from its
    usual memory makes the host wait for a CUDA device.
    """
    return torch.stack([like.new_full((), value) for value in values])

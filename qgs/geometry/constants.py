"""Fixed numbers as tensors, made on their device."""

from collections.abc import Sequence

import torch
from torch import Tensor


def constant(values: Sequence[float], like: Tensor) -> Tensor:
    """`values` (N,) in the dtype and on the device of `like`; the host waits for no copy."""
    return torch.stack([like.new_full((), value) for value in values])

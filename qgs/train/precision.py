"""Precision of training: what the forward pass, the gradients and the weights are computed in.

`training.precision` chooses among DTYPES. Weights, optimiser state and gradients of weights are
float32 in all of them; bfloat16 has the exponents of float32, so no GradScaler is needed. Geometry
leaves autocast by itself, see `qgs.geometry.precision`.
"""

import torch

DTYPES: dict[str, torch.dtype | None] = {"float32": None, "bf16": torch.bfloat16}
"""Values of `training.precision` to the dtype of autocast, None without autocast."""


def autocast(precision: str, device: str) -> torch.autocast:
    """Return the autocast of a forward pass. precision: of DTYPES; device: such as "cuda"."""
    dtype = DTYPES[precision]
    return torch.autocast(device, dtype, enabled=dtype is not None)

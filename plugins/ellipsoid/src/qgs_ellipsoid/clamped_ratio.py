"""A ratio of two products that is clamped, computed block by block.

`qgs_ellipsoid.ray_bias` imports this module when it is first called: `torch.compiler.disable`
imports the compiler, which takes most of a second.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

NUMERATOR = 20
"""Features of the numerator; those of the denominator follow."""

BLOCK = {"cpu": 2**19, "cuda": 2**24}
"""Pairs that are computed at a time: what stays in a cache, or in memory."""


class _ClampedRatio(torch.autograd.Function):
    """min(max((a @ f) / (c @ g), lower), 0), which keeps its result alone for the backward pass."""

    @staticmethod
    def forward(
        ctx: Any, above: Tensor, below: Tensor, features: Tensor, lower: Tensor, dtype: torch.dtype
    ) -> Tensor:
        ratio = above.new_empty(*above.shape[:2], features.shape[-1], dtype=dtype)
        of_above, of_below = features[:, :NUMERATOR], features[:, NUMERATOR:]
        for rows in _blocks(ratio):
            ratio[:, rows] = (above[:, rows] @ of_above).div_(below[:, rows] @ of_below)
        # Number bounds are twice as fast as tensor ones, but reading them would stall a GPU.
        if lower.device.type == "cpu":
            ratio.clamp_(lower.item(), 0.0)
        else:
            ratio.clamp_(lower, torch.zeros_like(lower))
        ctx.save_for_backward(above, below, features, lower, ratio)
        return ratio

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *factors, lower, ratio = ctx.saved_tensors
        (gradient,) = gradients
        at_lower = ratio <= lower
        inside = gradient.masked_fill(at_lower | (ratio >= 0), 0)
        above, below, features = factors
        parts = [torch.zeros_like(x) for x in factors]
        for rows in _blocks(ratio):
            fall = inside[:, rows] / (below[:, rows] @ features[:, NUMERATOR:])
            rise = -fall * ratio[:, rows]
            parts[0][:, rows] = fall @ features[:, :NUMERATOR].mT
            parts[1][:, rows] = rise @ features[:, NUMERATOR:].mT
            if ctx.needs_input_grad[2]:
                parts[2][:, :NUMERATOR] += above[:, rows].mT @ fall
                parts[2][:, NUMERATOR:] += below[:, rows].mT @ rise
        return (*parts, gradient.masked_fill(~at_lower, 0).sum().to(lower), None)


clamped_ratio: Any = torch.compiler.disable(_ClampedRatio.apply)
"""Kept out of compiled graphs, where its loop would be unrolled anew for every size."""


def _blocks(pairs: Tensor) -> list[slice]:
    """Slices of the anchors of (B, N, M), BLOCK pairs at a time."""
    batch, count, tokens = pairs.shape
    rows = max(BLOCK.get(pairs.device.type, BLOCK["cuda"]) // max(batch * tokens, 1), 1)
    return [slice(start, start + rows) for start in range(0, count, rows)]

"""A product that is clamped, computed block by block.

`qgs_locus.ray_bias` imports this module when it is first called: `torch.compiler.disable` imports
the compiler, which takes most of a second.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

BLOCK = {"cpu": 2**19, "cuda": 2**25}
"""Elements of the product that are computed at a time: what stays in a cache, or in memory."""


class _ClampedProduct(torch.autograd.Function):
    """min(max(left @ right, lower), 0), which keeps its result alone for the backward pass."""

    @staticmethod
    def forward(ctx: Any, left: Tensor, right: Tensor, lower: Tensor, dtype: torch.dtype) -> Tensor:
        (batch, count, _), tokens = left.shape, right.shape[-1]
        product = left.new_empty(batch, count, tokens, dtype=dtype)
        rows = max(BLOCK.get(left.device.type, BLOCK["cuda"]) // max(batch * tokens, 1), 1)
        for start in range(0, count, rows):
            product[:, start : start + rows] = left[:, start : start + rows] @ right
        # Number bounds are twice as fast as tensor ones, but reading them would stall a GPU.
        if lower.device.type == "cpu":
            product.clamp_(lower.item(), 0.0)
        else:
            product.clamp_(lower, torch.zeros_like(lower))
        ctx.save_for_backward(left, right, lower, product)
        return product

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        left, right, lower, product = ctx.saved_tensors
        (gradient,) = gradients
        needs_left, needs_right, needs_lower, _ = ctx.needs_input_grad
        at_lower = product <= lower
        inside = gradient.masked_fill(at_lower | (product >= 0), 0)
        to_left, to_right = right.to(inside).transpose(-1, -2), left.to(inside).transpose(-1, -2)
        return (
            (inside @ to_left).to(left) if needs_left else None,
            (to_right @ inside).to(right) if needs_right else None,
            gradient.masked_fill(~at_lower, 0).sum() if needs_lower else None,
            None,
        )


clamped_product: Any = torch.compiler.disable(_ClampedProduct.apply)
"""Kept out of compiled graphs, where its loop would be unrolled anew for every size."""

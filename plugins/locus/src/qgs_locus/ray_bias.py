"""The attention bias between anchors and image rays: b = -1/2 (D / sigma)^2.

D = |mu x d - m| is the distance of an anchor's centre mu to the line of a Plücker ray (m, d).
`ray_bias` computes it for all pairs as one product of F = 10 features; `ray_bias_direct` is the
formula as written, for tests. D^2 is a small difference of features that grow with |mu|^2, so the
product runs in float64, block by block: in float32, an anchor three units away with a small
bandwidth is off by more than the released code's own rounding.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from qgs.geometry.precision import full_precision
from qgs.geometry.rays import normalised_rays

BLOCK = {"cpu": 2**19, "cuda": 2**25}
"""Pairs that are computed at a time: as many as fit into a CPU's cache, or into GPU memory."""


def raised(x: Tensor) -> Tensor:
    """float64, where the device has it."""
    return x if x.device.type == "mps" else x.double()


def row_blocks(pairs_BNM: Tensor, block: Mapping[str, int]) -> list[slice]:
    """Slices of the N anchors with `block[device]` pairs each, at least one anchor."""
    batch, count, tokens = pairs_BNM.shape
    rows = max(block.get(pairs_BNM.device.type, block["cuda"]) // max(batch * tokens, 1), 1)
    return [slice(start, start + rows) for start in range(0, count, rows)]


def clamp_to_zero(bias_BNM: Tensor, lower: Tensor) -> None:
    """Clamp in place to [lower, 0], `lower` being 0-d."""
    # Number bounds are twice as fast as tensor ones, but reading them would stall a GPU.
    if lower.device.type == "cpu":
        bias_BNM.clamp_(lower.item(), 0.0)
    else:
        bias_BNM.clamp_(lower, torch.zeros_like(lower))


def outside_graphs(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """`function`, left out of compiled graphs, where its loop would be unrolled for every size.

    `torch.compiler.disable` does the same, but imports the compiler (0.8 s) at once.
    """

    def call(*arguments: Any) -> Tensor:
        outside: Any = torch.compiler.disable if torch.compiler.is_compiling() else lambda f: f
        return outside(function)(*arguments)

    return call


@full_precision
def ray_features(rays_BM6: Tensor, direction_eps: float = 1e-6) -> Tensor:
    """Ten features of each ray, float64: (B, M, 6) -> (B, 10, M).

    With k = d x m: D^2 = (xx, yy, zz, 2xy, 2xz, 2yz, -2x, -2y, -2z, 1) .
    (1-dx^2, 1-dy^2, 1-dz^2, -dx dy, -dx dz, -dy dz, kx, ky, kz, |m|^2).
    direction_eps: least |d| that the ray is divided by.
    """
    m_BM3, d_BM3 = map(raised, normalised_rays(rays_BM6, direction_eps))
    dx, dy, dz = d_BM3.unbind(-1)
    kx, ky, kz = torch.linalg.cross(d_BM3, m_BM3, dim=-1).unbind(-1)
    squares = [dy * dy + dz * dz, dx * dx + dz * dz, dx * dx + dy * dy]
    products = [-dx * dy, -dx * dz, -dy * dz]
    return torch.stack([*squares, *products, kx, ky, kz, m_BM3.square().sum(-1)], -2)


@full_precision
def center_features(center_BN3: Tensor) -> Tensor:
    """The ten features of each centre, float64: (B, N, 3) -> (B, N, 10)."""
    x, y, z = raised(center_BN3).unbind(-1)
    products = [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z]
    return torch.stack([*products, -2 * x, -2 * y, -2 * z, torch.ones_like(x)], -1)


@full_precision
def ray_bias(
    center_BN3: Tensor, sigma_sq: Tensor | float, rays_BFM: Tensor, bias_min: float, gamma: Tensor
) -> Tensor:
    """gamma * clamp(-D^2 / (2 sigma^2), bias_min, 0), (B, N, M), in the dtype of the centres.

    sigma_sq: (B, N, 1) or a number. rays_BFM: `ray_features`, the same for all layers.
    gamma: 0-d, positive; multiplied into the centres' features and the clamp.
    """
    scaled_BNF = center_features(center_BN3) * (-0.5 * gamma / sigma_sq)
    return _clamped_product(scaled_BNF, rays_BFM, bias_min * gamma, center_BN3.dtype)


class _ClampedProduct(torch.autograd.Function):
    """min(max(left @ right, lower), 0); of (B, N, M) tensors, only the result is kept."""

    @staticmethod
    def forward(
        ctx: Any, left_BNF: Tensor, right_BFM: Tensor, lower: Tensor, dtype: torch.dtype
    ) -> Tensor:
        bias_BNM = left_BNF.new_empty(*left_BNF.shape[:2], right_BFM.shape[-1], dtype=dtype)
        for rows in row_blocks(bias_BNM, BLOCK):
            bias_BNM[:, rows] = left_BNF[:, rows] @ right_BFM
        clamp_to_zero(bias_BNM, lower)
        ctx.save_for_backward(left_BNF, right_BFM, lower, bias_BNM)
        return bias_BNM

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        left_BNF, right_BFM, lower, bias_BNM = ctx.saved_tensors
        needs_left, needs_right, needs_lower, _ = ctx.needs_input_grad
        at_lower = bias_BNM <= lower
        inside_BNM = gradients[0].masked_fill(at_lower | (bias_BNM >= 0), 0)
        return (
            (inside_BNM @ right_BFM.to(inside_BNM).mT).to(left_BNF) if needs_left else None,
            (left_BNF.to(inside_BNM).mT @ inside_BNM).to(right_BFM) if needs_right else None,
            gradients[0].masked_fill(~at_lower, 0).sum() if needs_lower else None,
            None,
        )


_clamped_product = outside_graphs(_ClampedProduct.apply)


@full_precision
def ray_bias_direct(
    center_BN3: Tensor,
    sigma_sq: Tensor | float,
    rays_BM6: Tensor,
    bias_min: float,
    gamma: Tensor,
    direction_eps: float = 1e-6,
) -> Tensor:
    """`ray_bias` as the paper writes it, through (B, N, M, 3) cross products.

    rays_BM6: not normalised.
    """
    m_BM3, d_BM3 = normalised_rays(rays_BM6, direction_eps)
    crossed_BNM3 = torch.linalg.cross(center_BN3[:, :, None], d_BM3[:, None], dim=-1)
    distance_sq_BNM = (crossed_BNM3 - m_BM3[:, None]).square().sum(-1)
    return gamma * (-0.5 * distance_sq_BNM / sigma_sq).clamp(bias_min, 0)

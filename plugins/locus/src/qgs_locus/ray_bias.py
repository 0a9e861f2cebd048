"""The attention bias between anchors and image rays: b = -1/2 (D / sigma)^2.

D = |mu x d - m| is the distance of an anchor's centre mu to the line of a Plücker ray (m, d).
`ray_bias` computes it for all pairs in one product of ten features; `ray_bias_direct` spells the
formula out and is what the tests hold the fast one against. D^2 is a small difference of features
that grow with |mu|^2, so the product runs in float64, block by block; in float32 an anchor three
units away with a small bandwidth is off by more than the released code's own rounding.
"""

from __future__ import annotations

import torch
from torch import Tensor

from qgs.geometry.precision import full_precision
from qgs.geometry.rays import normalised_rays


def _raised(x: Tensor) -> Tensor:
    """float64, where the device has it."""
    return x if x.device.type == "mps" else x.double()


@full_precision
def ray_features(patch_rays: Tensor, direction_eps: float = 1e-6) -> Tensor:
    """Ten features of each ray, float64: (B, M, 6) -> (B, 10, M).

    With k = d x m: D^2 = (xx, yy, zz, 2xy, 2xz, 2yz, -2x, -2y, -2z, 1) .
    (1-dx^2, 1-dy^2, 1-dz^2, -dx dy, -dx dz, -dy dz, kx, ky, kz, |m|^2).
    direction_eps: floor of |d| before the ray is normalised.
    """
    moments, directions = map(_raised, normalised_rays(patch_rays, direction_eps))
    dx, dy, dz = directions.unbind(-1)
    kx, ky, kz = torch.linalg.cross(directions, moments, dim=-1).unbind(-1)
    squares = [dy * dy + dz * dz, dx * dx + dz * dz, dx * dx + dy * dy]
    products = [-dx * dy, -dx * dz, -dy * dz]
    return torch.stack([*squares, *products, kx, ky, kz, moments.square().sum(-1)], -2)


@full_precision
def center_features(center: Tensor) -> Tensor:
    """The ten features of each centre, float64: (B, N, 3) -> (B, N, 10)."""
    x, y, z = _raised(center).unbind(-1)
    products = [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z]
    return torch.stack([*products, -2 * x, -2 * y, -2 * z, torch.ones_like(x)], -1)


@full_precision
def ray_bias(
    center: Tensor, sigma_sq: Tensor | float, features: Tensor, bias_min: float, gamma: Tensor
) -> Tensor:
    """gamma * clamp(-D^2 / (2 sigma^2), bias_min, 0), (B, N, M), in the dtype of `center`.

    center (B, N, 3); sigma_sq (B, N, 1) or a number; features (B, 10, M) of `ray_features`, which
    all layers share; gamma 0-d, positive: folded into the centre's features and into the clamp.
    """
    from qgs_locus.clamped_product import clamped_product

    scaled = center_features(center) * (-0.5 * gamma / sigma_sq)
    return clamped_product(scaled, features, bias_min * gamma, center.dtype)


@full_precision
def ray_bias_direct(
    center: Tensor,
    sigma_sq: Tensor | float,
    patch_rays: Tensor,
    bias_min: float,
    gamma: Tensor,
    direction_eps: float = 1e-6,
) -> Tensor:
    """`ray_bias` as the paper writes it, through a (B, N, M, 3) cross product.

    patch_rays (B, M, 6), not normalised.
    """
    moments, directions = normalised_rays(patch_rays, direction_eps)
    residual = torch.linalg.cross(center[:, :, None], directions[:, None], dim=-1)
    distance_sq = (residual - moments[:, None]).square().sum(-1)
    return gamma * (-0.5 * distance_sq / sigma_sq).clamp(bias_min, 0)

"""The attention bias between anchors and image rays: b = -1/2 (D / sigma)^2.

D = |mu x d - m| is the distance of an anchor's centre mu to the line of a Plücker ray (m, d).
`ray_bias` computes it for all pairs in one product of ten features; `ray_bias_direct` spells the
formula out and is what the tests hold the fast one against.
"""

from __future__ import annotations

import torch
from torch import Tensor

from qgs.geometry.precision import full_precision
from qgs.geometry.rays import normalised_rays


@full_precision
def ray_features(patch_rays: Tensor) -> Tensor:
    """Ten features of each ray: (B, M, 6) -> (B, 10, M).

    With k = d x m: D^2 = (xx, yy, zz, 2xy, 2xz, 2yz, -2x, -2y, -2z, 1) .
    (1-dx^2, 1-dy^2, 1-dz^2, -dx dy, -dx dz, -dy dz, kx, ky, kz, |m|^2).
    """
    moments, directions = normalised_rays(patch_rays)
    dx, dy, dz = directions.unbind(-1)
    kx, ky, kz = torch.linalg.cross(directions, moments, dim=-1).unbind(-1)
    squares = [dy * dy + dz * dz, dx * dx + dz * dz, dx * dx + dy * dy]
    products = [-dx * dy, -dx * dz, -dy * dz]
    return torch.stack([*squares, *products, kx, ky, kz, moments.square().sum(-1)], -2)


@full_precision
def center_features(center: Tensor) -> Tensor:
    """The ten features of each centre: (B, N, 3) -> (B, N, 10)."""
    x, y, z = center.unbind(-1)
    products = [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z]
    return torch.stack([*products, -2 * x, -2 * y, -2 * z, torch.ones_like(x)], -1)


@full_precision
def ray_bias(
    center: Tensor, sigma_sq: Tensor | float, patch_rays: Tensor, bias_min: float, gamma: Tensor
) -> Tensor:
    """gamma * clamp(-D^2 / (2 sigma^2), bias_min, 0), (B, N, M).

    center (B, N, 3); sigma_sq (B, N, 1) or a number; patch_rays (B, M, 6), not normalised;
    gamma 0-d, positive: it is folded into the centre's features and into the clamp.
    """
    scaled = center_features(center) * (-0.5 * gamma / sigma_sq)
    bias = scaled @ ray_features(patch_rays)
    return bias.clamp_(bias_min * gamma, torch.zeros_like(gamma))


@full_precision
def ray_bias_direct(
    center: Tensor, sigma_sq: Tensor | float, patch_rays: Tensor, bias_min: float, gamma: Tensor
) -> Tensor:
    """`ray_bias` as it is written in the paper, through the (B, N, M, 3) cross product."""
    moments, directions = normalised_rays(patch_rays)
    residual = torch.linalg.cross(center[:, :, None], directions[:, None], dim=-1)
    distance_sq = (residual - moments[:, None]).square().sum(-1)
    return gamma * (-0.5 * distance_sq / sigma_sq).clamp(bias_min, 0)

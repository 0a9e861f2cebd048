"""The attention bias between ellipsoidal anchors and image rays: b = -1/2 min (x-mu)' A (x-mu).

The minimum is over the points x of a ray; A = R diag(1 / sigma^2) R' is the anchor's own metric
with bandwidths sigma_i = sigma0 r_i. For a Plücker ray (m, d) and e = m - mu x d it is
e' adj(A) e / d' A d: the squared moment of the ray over its squared direction, both in coordinates
where the ellipsoid is a unit ball (Wa x Wb = cof(W) (a x b), with A = W' W).

The numerator is a quadratic form in (m, d). Its mixed part adj(A) [mu]x has no trace, so that 20
features of a ray are enough, and none of them could be spared; the denominator takes the 6 products
of d. LocusGS's isotropic bias takes 10. Both products run in float64, block by block, as its does.
"""

from __future__ import annotations

import torch
from torch import Tensor

from qgs.geometry.precision import full_precision
from qgs.geometry.rays import normalised_rays
from qgs_ellipsoid.rotations import unit


def _raised(x: Tensor) -> Tensor:
    """float64, where the device has it."""
    return x if x.device.type == "mps" else x.double()


def _products(v: Tensor) -> list[Tensor]:
    """xx, yy, zz, xy, xz, yz of vectors (..., 3)."""
    x, y, z = v.unbind(-1)
    return [x * x, y * y, z * z, x * y, x * z, y * z]


def _quadratic(form: Tensor) -> list[Tensor]:
    """What symmetric matrices (..., 3, 3) weigh `_products` with."""
    pairs = ((0, 1), (0, 2), (1, 2))
    return [form[..., i, i] for i in range(3)] + [2 * form[..., i, j] for i, j in pairs]


def _crossed(v: Tensor) -> Tensor:
    """[v]x (..., 3, 3), the matrix that makes v x d of d."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def _cofactors(matrix: Tensor) -> Tensor:
    """Cofactor matrices of (..., 3, 3)."""
    return torch.linalg.cross(matrix.roll(-1, -1), matrix.roll(-2, -1), dim=-2)


UPWARD = (0.0, 0.0, 1.0)
"""Stands for the direction of a ray that has none."""

OFF_DIAGONAL = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))


@full_precision
def ray_features(patch_rays: Tensor, direction_eps: float = 1e-6) -> Tensor:
    """26 features of each ray, float64: (B, M, 6) -> (B, 26, M).

    The 20 of the numerator are the products of m, m_i d_j without their trace, and the products of
    d; the 6 of the denominator those of the unit direction. direction_eps: floor of |d| before the
    ray is normalised; a direction that stays shorter for it counts as in LocusGS's bias.
    """
    moments, directions = map(_raised, normalised_rays(patch_rays, direction_eps))
    mixed = moments[..., :, None] * directions[..., None, :]
    trace_free = [mixed[..., i, i] - mixed[..., 2, 2] for i in (0, 1)]
    trace_free += [mixed[..., i, j] for i, j in OFF_DIAGONAL]
    numerator = [*_products(moments), *trace_free, *_products(directions)]
    return torch.stack([*numerator, *_products(unit(directions, UPWARD))], -2)


@full_precision
def anchor_features(center: Tensor, rotation: Tensor, sigma_sq: Tensor) -> tuple[Tensor, Tensor]:
    """Weights of the ray features, float64: numerator (B, N, 20), denominator (B, N, 6).

    center (B, N, 3); rotation (B, N, 3, 3), anchor to world; sigma_sq (B, N, 3), along its axes.
    """
    center, rotation, sigma_sq = map(_raised, (center, rotation, sigma_sq))
    metric = (rotation / sigma_sq[..., None, :]) @ rotation.mT
    # R is its own cofactor matrix but for its rounding, which this keeps out of the ratio.
    cofactors = _cofactors(rotation)
    weights = sigma_sq / sigma_sq.prod(-1, keepdim=True)
    adjugate = (cofactors * weights[..., None, :]) @ cofactors.mT
    crossed = _crossed(center)
    mixed = adjugate @ crossed
    around = crossed.mT @ mixed
    trace_free = [mixed[..., i, j] for i, j in ((0, 0), (1, 1), *OFF_DIAGONAL)]
    numerator = [*_quadratic(adjugate), *(-2 * x for x in trace_free), *_quadratic(around)]
    return torch.stack(numerator, -1), torch.stack(_quadratic(metric), -1)


@full_precision
def ellipsoid_bias(
    center: Tensor,
    rotation: Tensor,
    sigma_sq: Tensor,
    features: Tensor,
    bias_min: float,
    gamma: Tensor,
) -> Tensor:
    """gamma * clamp(b, bias_min, 0), (B, N, M), in the dtype of `center`.

    center (B, N, 3); rotation (B, N, 3, 3), anchor to world; sigma_sq (B, N, 3); features
    (B, 26, M) of `ray_features`, which all layers share; gamma 0-d, positive.
    """
    from qgs_ellipsoid.clamped_ratio import clamped_ratio

    numerator, denominator = anchor_features(center, rotation, sigma_sq)
    scaled = numerator * (-0.5 * gamma)
    lower = bias_min * gamma
    return clamped_ratio(scaled, denominator, features, lower, center.dtype)


@full_precision
def ellipsoid_bias_direct(
    center: Tensor,
    rotation: Tensor,
    sigma_sq: Tensor,
    patch_rays: Tensor,
    bias_min: float,
    gamma: Tensor,
    direction_eps: float = 1e-6,
) -> Tensor:
    """`ellipsoid_bias` by its definition, in coordinates where the ellipsoid is a unit ball.

    There a direction is W d and the moment around the centre cof(W) (m - mu x d), with W' W = A;
    through (B, N, M, 3) tensors. patch_rays (B, M, 6), not normalised.
    """
    moments, directions = normalised_rays(patch_rays, direction_eps)
    around = moments[:, None] - torch.linalg.cross(center[:, :, None], directions[:, None], dim=-1)
    whitening = (rotation / sigma_sq.sqrt()[..., None, :]).mT
    moment = torch.einsum("bnij,bnmj->bnmi", _cofactors(whitening), around)
    along = torch.einsum("bnij,bmj->bnmi", whitening, unit(directions, UPWARD))
    distance_sq = moment.square().sum(-1) / along.square().sum(-1)
    return gamma * (-0.5 * distance_sq).clamp(bias_min, 0)

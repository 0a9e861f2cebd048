"""The attention bias between ellipsoidal anchors and image rays: b = -1/2 min (x-mu)' A (x-mu).

The minimum is over the points x of a ray; A = R diag(1 / sigma^2) R' is the anchor's own metric
with bandwidths sigma_i = sigma0 r_i. For a Plücker ray (m, d) and e = m - mu x d it is
e' adj(A) e / d' A d: the squared moment of the ray over its squared direction, both in coordinates
where the ellipsoid is a unit ball (Wa x Wb = cof(W) (a x b), with A = W' W).

The numerator is a quadratic form in (m, d). Its mixed part adj(A) [mu]x has no trace, so that 20
features of a ray are enough (and no fewer would be); the denominator takes the 6 products of d.
LocusGS's isotropic bias takes 10. Both products run in float64, block by block, as LocusGS's does.

Axes: F = 20 features of the numerator, E = 6 of the denominator.
"""

from typing import Any

import torch
from qgs_locus.ray_bias import clamp_to_zero, outside_graphs, raised, row_blocks
from torch import Tensor

from qgs.geometry.precision import full_precision
from qgs.geometry.rays import normalised_rays
from qgs_ellipsoid.rotations import unit

NUMERATOR = 20
"""Features of the numerator; those of the denominator follow."""

BLOCK = {"cpu": 2**19, "cuda": 2**24}
"""Pairs that are computed at a time: as many as fit into a CPU's cache, or into GPU memory."""

UPWARD = (0.0, 0.0, 1.0)
"""The direction of a ray that has none."""

OFF_DIAGONAL = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))


def _products(v: Tensor) -> list[Tensor]:
    """xx, yy, zz, xy, xz, yz of vectors (..., 3)."""
    x, y, z = v.unbind(-1)
    return [x * x, y * y, z * z, x * y, x * z, y * z]


def _quadratic(form: Tensor) -> list[Tensor]:
    """The factors of `_products(v)` in v' form v, for symmetric matrices (..., 3, 3)."""
    pairs = ((0, 1), (0, 2), (1, 2))
    return [form[..., i, i] for i in range(3)] + [2 * form[..., i, j] for i, j in pairs]


def _cross_matrix(v: Tensor) -> Tensor:
    """[v]x (..., 3, 3), the matrix with [v]x d = v x d."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def _cofactors(matrix: Tensor) -> Tensor:
    """Cofactor matrices of (..., 3, 3)."""
    return torch.linalg.cross(matrix.roll(-1, -1), matrix.roll(-2, -1), dim=-2)


@full_precision
def ray_features(rays_BM6: Tensor, direction_eps: float = 1e-6) -> Tensor:
    """26 features of each ray, float64: (B, M, 6) -> (B, 26, M).

    The 20 of the numerator are the products of m, m_i d_j without their trace, and the products of
    d; the 6 of the denominator those of the unit direction. direction_eps: least |d| that the ray
    is divided by; a shorter direction counts as in LocusGS's bias.
    """
    m_BM3, d_BM3 = map(raised, normalised_rays(rays_BM6, direction_eps))
    mixed = m_BM3[..., :, None] * d_BM3[..., None, :]
    trace_free = [mixed[..., i, i] - mixed[..., 2, 2] for i in (0, 1)]
    trace_free += [mixed[..., i, j] for i, j in OFF_DIAGONAL]
    numerator = [*_products(m_BM3), *trace_free, *_products(d_BM3)]
    return torch.stack([*numerator, *_products(unit(d_BM3, UPWARD))], -2)


@full_precision
def anchor_features(
    center_BN3: Tensor, rotation_BN33: Tensor, sigma_sq_BN3: Tensor
) -> tuple[Tensor, Tensor]:
    """Weights of the ray features, float64: numerator (B, N, 20), denominator (B, N, 6).

    rotation: anchor to world. sigma_sq: along the axes of the anchor.
    """
    center, rotation, sigma_sq = map(raised, (center_BN3, rotation_BN33, sigma_sq_BN3))
    metric = (rotation / sigma_sq[..., None, :]) @ rotation.mT
    # A rotation is its own cofactor matrix but for rounding, which this keeps out of the ratio.
    cofactors = _cofactors(rotation)
    weights = sigma_sq / sigma_sq.prod(-1, keepdim=True)
    adjugate = (cofactors * weights[..., None, :]) @ cofactors.mT
    crossed = _cross_matrix(center)
    mixed = adjugate @ crossed
    around = crossed.mT @ mixed
    trace_free = [mixed[..., i, j] for i, j in ((0, 0), (1, 1), *OFF_DIAGONAL)]
    numerator = [*_quadratic(adjugate), *(-2 * x for x in trace_free), *_quadratic(around)]
    return torch.stack(numerator, -1), torch.stack(_quadratic(metric), -1)


@full_precision
def ellipsoid_bias(
    center_BN3: Tensor,
    rotation_BN33: Tensor,
    sigma_sq_BN3: Tensor,
    features: Tensor,
    bias_min: float,
    gamma: Tensor,
) -> Tensor:
    """gamma * clamp(b, bias_min, 0), (B, N, M), in the dtype of the centres.

    rotation, sigma_sq: see `anchor_features`. features: (B, 26, M) of `ray_features`, the same for
    all layers. gamma: 0-d, positive.
    """
    above_BNF, below_BNE = anchor_features(center_BN3, rotation_BN33, sigma_sq_BN3)
    lower, dtype = bias_min * gamma, center_BN3.dtype
    return _clamped_ratio(above_BNF * (-0.5 * gamma), below_BNE, features, lower, dtype)


class _ClampedRatio(torch.autograd.Function):
    """min(max((a @ f) / (c @ g), lower), 0); of (B, N, M) tensors, only the result is kept."""

    @staticmethod
    def forward(
        ctx: Any, above: Tensor, below: Tensor, features: Tensor, lower: Tensor, dtype: torch.dtype
    ) -> Tensor:
        bias_BNM = above.new_empty(*above.shape[:2], features.shape[-1], dtype=dtype)
        of_above, of_below = features[:, :NUMERATOR], features[:, NUMERATOR:]
        for rows in row_blocks(bias_BNM, BLOCK):
            bias_BNM[:, rows] = (above[:, rows] @ of_above).div_(below[:, rows] @ of_below)
        clamp_to_zero(bias_BNM, lower)
        ctx.save_for_backward(above, below, features, lower, bias_BNM)
        return bias_BNM

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *factors, lower, bias_BNM = ctx.saved_tensors
        at_lower = bias_BNM <= lower
        inside_BNM = gradients[0].masked_fill(at_lower | (bias_BNM >= 0), 0)
        above, below, features = factors
        grads = [torch.zeros_like(x) for x in factors]
        for rows in row_blocks(bias_BNM, BLOCK):
            up = inside_BNM[:, rows] / (below[:, rows] @ features[:, NUMERATOR:])
            down = -up * bias_BNM[:, rows]
            grads[0][:, rows] = up @ features[:, :NUMERATOR].mT
            grads[1][:, rows] = down @ features[:, NUMERATOR:].mT
            if ctx.needs_input_grad[2]:
                grads[2][:, :NUMERATOR] += above[:, rows].mT @ up
                grads[2][:, NUMERATOR:] += below[:, rows].mT @ down
        return (*grads, gradients[0].masked_fill(~at_lower, 0).sum().to(lower), None)


_clamped_ratio = outside_graphs(_ClampedRatio.apply)


@full_precision
def ellipsoid_bias_direct(
    center_BN3: Tensor,
    rotation_BN33: Tensor,
    sigma_sq_BN3: Tensor,
    rays_BM6: Tensor,
    bias_min: float,
    gamma: Tensor,
    direction_eps: float = 1e-6,
) -> Tensor:
    """`ellipsoid_bias` by its definition, in coordinates where the ellipsoid is a unit ball.

    There a direction is W d and the moment around the centre cof(W) (m - mu x d), with W' W = A;
    through (B, N, M, 3) tensors. rays_BM6: not normalised.
    """
    m_BM3, d_BM3 = normalised_rays(rays_BM6, direction_eps)
    e_BNM3 = m_BM3[:, None] - torch.linalg.cross(center_BN3[:, :, None], d_BM3[:, None], dim=-1)
    w_BN33 = (rotation_BN33 / sigma_sq_BN3.sqrt()[..., None, :]).mT
    moment_BNM3 = torch.einsum("bnij,bnmj->bnmi", _cofactors(w_BN33), e_BNM3)
    along_BNM3 = torch.einsum("bnij,bmj->bnmi", w_BN33, unit(d_BM3, UPWARD))
    distance_sq_BNM = moment_BNM3.square().sum(-1) / along_BNM3.square().sum(-1)
    return gamma * (-0.5 * distance_sq_BNM).clamp(bias_min, 0)

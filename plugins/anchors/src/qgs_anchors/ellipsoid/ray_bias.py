"""Attention bias between ellipsoidal anchors and image rays: b = -1/2 min |W (p - mu)|^2.

The minimum is over the points p of a ray; mu is the anchor's centre. W = diag(1 / sigma) R' maps
the ellipsoid with semi-axes sigma_i = sigma0 r_i to a unit ball. R' is the transposed rotation of
the anchor, r_i are its radii, and sigma0 is an option. A Plücker ray has the direction d and the
moment m. W maps d to W d. It maps the ray's moment around the centre to cof(W) (m - mu x d), with
cof(W) the cofactor matrix and x the cross product, because W a x W b = cof(W) (a x b). So the
minimum is |cof(W) (m - mu x d)|^2 / |W d|^2.
"""

from typing import Self

import torch
from qgs_locus.kernels.attention_bias import AttentionBias
from qgs_locus.ray_bias import clamped, normalised_rays
from torch import Tensor

from qgs.geometry.transforms import unit
from qgs.precision import full_precision

UPWARD = (0.0, 0.0, 1.0)
"""Unit direction that `ray_tokens` returns for a ray whose direction is the zero vector."""


@full_precision
def ray_tokens(rays_BM6: Tensor, direction_eps: float = 1e-6) -> Tensor:
    """Return moment, direction and unit direction of each ray (B, M, 6) as a column (B, 9, M).

    Moment and direction of a ray are first divided by max(|direction|, `direction_eps`).
    """
    m_BM3, d_BM3 = normalised_rays(rays_BM6, direction_eps)
    return torch.cat([m_BM3, d_BM3, unit(d_BM3, UPWARD)], -1).mT.contiguous()


class EllipsoidBias(AttentionBias):
    """Bias gamma * max(b, bias_min) between ellipsoidal anchors and image rays.

    The numbers of a query are the anchor's centre mu, the rows of cof(W), the rows of W, gamma / 2
    and gamma * bias_min. The numbers of a token are moment m, direction d and unit direction
    d / |d| of its ray. gamma is a weight. The docstring of this module defines b, W and cof(W).
    """

    kernels = "qgs_anchors.ellipsoid.ray_bias_numba"

    @classmethod
    @full_precision
    def of(
        cls,
        center_BN3: Tensor,
        rotation_BN33: Tensor,
        sigma_sq_BN3: Tensor,
        tokens_B9M: Tensor,
        bias_min: float,
        gamma: Tensor,
    ) -> Self:
        """Make the attention bias of a decoder layer.

        center: anchor centres, world frame. rotation: rotation matrices, anchor to world. sigma_sq:
        squared bandwidths along the anchor's axes. tokens: result of `ray_tokens`. bias_min: lower
        bound of bias / gamma. gamma: weight > 0, 0-d.
        """
        sigma_BN3 = sigma_sq_BN3.sqrt()
        ball_BN9 = (rotation_BN33 / sigma_BN3[..., None, :]).mT.flatten(2)
        weights_BN3 = sigma_BN3 / sigma_BN3.prod(-1, keepdim=True)
        # A rotation equals its cofactor matrix up to rounding; the ratio must not see the rounding.
        cofactors_BN9 = (_cofactors(rotation_BN33) * weights_BN3[..., None, :]).mT.flatten(2)
        # Kernels read all numbers of a query from one row.
        rest_BN2 = torch.stack([gamma / 2, gamma * bias_min]).expand(*center_BN3.shape[:2], 2)
        parts = [center_BN3, cofactors_BN9, ball_BN9, rest_BN2]
        return cls(torch.cat(parts, -1), tokens_B9M)

    @staticmethod
    def value(queries_nF: Tensor, tokens_GM: Tensor) -> Tensor:
        """Return the bias (n, M) of n queries and the M tokens of a scene.

        queries: 23 numbers of each query (n, 23). tokens: nine numbers of each token (9, M).
        """
        center_n3, *matrices, factor_n1, lower_n1 = queries_nF.split([3, 9, 9, 1, 1], -1)
        cofactors_n33, ball_n33 = (matrix.unflatten(-1, (3, 3)) for matrix in matrices)
        m_M3, d_M3, unit_M3 = (x_3M.mT for x_3M in tokens_GM.split(3))
        # Not expanded into products: far from the cameras, m and mu x d nearly cancel.
        e_nM3 = m_M3 - torch.linalg.cross(center_n3[:, None], d_M3[None])
        moment_nM = _times(cofactors_n33, e_nM3).square().sum(-1)
        along_nM = _times(ball_n33, unit_M3[None]).square().sum(-1)
        return clamped(-factor_n1 * moment_nM / along_nM, lower_n1)


def _times(matrix_n33: Tensor, vectors: Tensor) -> Tensor:
    """Multiply matrices (n, 3, 3) by vectors (n or 1, M, 3) to (n, M, 3), in full float32.

    A matrix product could use a GPU's matrix units, which are less exact.
    """
    return (matrix_n33[:, None] * vectors[..., None, :]).sum(-1)


def _cofactors(matrix: Tensor) -> Tensor:
    """Return the cofactor matrices (..., 3, 3) of matrices (..., 3, 3)."""
    return torch.linalg.cross(matrix.roll(-1, -1), matrix.roll(-2, -1), dim=-2)

"""Attention bias that depends on the distance of anchor and image ray.

`dense_bias` is the reference: it follows equations (2) and (3) of the plugin's README line by line,
for all pairs of anchor and ray at once. `RayBias` computes the same numbers for blocks of queries.
The tests compare both.
"""

from typing import Self

import torch
from torch import Tensor

from qgs.precision import full_precision
from qgs_locus.kernels.attention_bias import AttentionBias


@full_precision
def normalised_rays(rays: Tensor, eps: float = 1e-6) -> tuple[Tensor, Tensor]:
    """Divide Plücker rays (m, d) by max(|d|, `eps`), so that directions have unit length.

    Takes rays (..., 6), moment m first. Returns moments (..., 3) and directions (..., 3).
    """
    moments, directions = rays.split(3, dim=-1)
    length = directions.norm(dim=-1, keepdim=True).clamp_min(eps)
    return moments / length, directions / length


@full_precision
def dense_bias(
    center: Tensor,  # (B, N, 3) mu, world
    sigma_sq: Tensor | float,  # (B, N, 1) sigma^2, world units squared, or one number
    rays: Tensor,  # (B, M, 6) Plücker rays of patches, world
    bias_min: float,
) -> Tensor:
    """Return the bias b (B, N, M) of each anchor and ray, without its weight gamma.

    bias_min: lower bound of b.
    """
    # A patch's ray is the mean of its pixels' rays, so |d| < 1; D needs |d| = 1.
    moment, direction = (x[:, None] for x in normalised_rays(rays))
    # (2). In float32: for rays that pass near, D is a small difference of numbers of size |mu|.
    D = (torch.linalg.cross(center[:, :, None], direction, dim=-1) - moment).norm(dim=-1)
    sigma = sigma_sq**0.5
    b = -1 / 2 * (D / sigma) ** 2  # (3)
    # Rays beyond about 6 sigma count the same: an anchor far from all rays attends by content.
    return b.clamp_min(bias_min)


@full_precision
def ray_tokens(rays_BM6: Tensor, direction_eps: float = 1e-6) -> Tensor:
    """Normalise rays (B, M, 6), and return them as columns (B, 6, M), moments before directions.

    Each ray is divided by the length of its direction, or by `direction_eps` if the length is less.
    """
    return torch.cat(normalised_rays(rays_BM6, direction_eps), -1).mT.contiguous()


class RayBias(AttentionBias):
    """Attention bias max(-factor D^2, lower), with D the distance of anchor centre and ray.

    Each query has five numbers: its anchor's centre, factor = gamma / (2 sigma^2) and
    lower = gamma * bias_min, with weight gamma and bandwidth sigma. Each token has six: moment and
    direction of its ray. So kernels compute only D for each pair of query and token.
    """

    in_triton = True
    kernels = "qgs_locus.kernels.ray_bias_numba"

    @classmethod
    @full_precision
    def of(
        cls,
        center_BN3: Tensor,
        sigma_sq: Tensor | float,
        tokens_B6M: Tensor,
        bias_min: float,
        gamma: Tensor,
    ) -> Self:
        """Make the attention bias of a decoder layer.

        center: anchor centres, world frame. sigma_sq: squared bandwidths (B, N, 1), or one number.
        tokens: result of `ray_tokens`. bias_min: lower bound of bias / gamma. gamma: 0-d, above 0.
        """
        # Kernels read one row per query, even if all queries share a number.
        each_BN1 = torch.ones_like(center_BN3[..., :1])
        parts = [center_BN3, each_BN1 * (gamma / (2 * sigma_sq)), each_BN1 * (gamma * bias_min)]
        return cls(torch.cat(parts, -1), tokens_B6M)

    @staticmethod
    def value(queries_nF: Tensor, tokens_GM: Tensor) -> Tensor:
        """Return the bias (n, M) of n queries and the M tokens of a scene.

        D^2 = |mu x d - m|^2 is computed from the components of mu x d, of which a compiler makes
        one kernel. A single matrix product would be off by several logits for anchors far from the
        cameras.
        """
        x_n1, y_n1, z_n1, factor_n1, lower_n1 = queries_nF.split(1, -1)
        m0_M, m1_M, m2_M, d0_M, d1_M, d2_M = tokens_GM.unbind()
        e0_nM = y_n1 * d2_M - z_n1 * d1_M - m0_M
        e1_nM = z_n1 * d0_M - x_n1 * d2_M - m1_M
        e2_nM = x_n1 * d1_M - y_n1 * d0_M - m2_M
        distance_sq_nM = e0_nM.square() + e1_nM.square() + e2_nM.square()
        return clamped(-factor_n1 * distance_sq_nM, lower_n1)


def clamped(bias_nM: Tensor, lower_n1: Tensor) -> Tensor:
    """Return max(bias, lower). Where the maximum is `lower`, the gradient goes to `lower`."""
    # The condition is false for NaN, so that NaN stays.
    return torch.where(bias_nM <= lower_n1, lower_n1, bias_nM)

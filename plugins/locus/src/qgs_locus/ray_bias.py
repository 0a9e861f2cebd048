"""Attention bias between anchors and image rays: equations (2) and (3) of the README.

`dense_bias` is the reference: it follows the README line by line, for all pairs at once. `RayBias`
computes the same for blocks of queries, in a form for kernels. The tests compare both.
"""

from typing import Self

import torch
from torch import Tensor

from qgs.precision import full_precision
from qgs_locus.kernels.attention_bias import AttentionBias, Kernel


@full_precision
def normalised_rays(rays: Tensor, eps: float = 1e-6) -> tuple[Tensor, Tensor]:
    """Return Plücker rays (m, d) / max(|d|, `eps`), whose directions have unit length.

    rays (..., 6), moment first -> moments (..., 3), directions (..., 3).
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
    """Return b (B, N, M), without its weight gamma."""
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
    """Return moments and directions as rows: (B, M, 6) -> (B, 6, M).

    direction_eps: lower bound of the |d| by which a ray is divided.
    """
    return torch.cat(normalised_rays(rays_BM6, direction_eps), -1).mT.contiguous()


class RayBias(AttentionBias):
    """Bias gamma b in the form for kernels: max(-factor D^2, lower).

    Each query has five numbers: mu, factor = gamma / (2 sigma^2) and lower = gamma bias_min. Each
    token has m and d. Everything that does not depend on the pair is computed once.
    """

    in_triton = True

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
        """Make the bias of a layer.

        sigma_sq: (B, N, 1) or a number. tokens: from `ray_tokens`, the same for all layers.
        gamma: 0-d, positive.
        """
        # Kernels read one row per query, even if all queries share a number.
        each_BN1 = torch.ones_like(center_BN3[..., :1])
        parts = [center_BN3, each_BN1 * (gamma / (2 * sigma_sq)), each_BN1 * (gamma * bias_min)]
        return cls(torch.cat(parts, -1), tokens_B6M)

    def value(self, queries_nF: Tensor, tokens_GM: Tensor) -> Tensor:
        """Return the bias (n, M), through cross products (n, M, 3).

        |mu x d - m|^2 is computed as written. A matrix product of features of mu and of the ray
        would be off by several logits far from the cameras.
        """
        center_n3, factor_n1, lower_n1 = queries_nF.split([3, 1, 1], -1)
        m_M3 = tokens_GM[:3].mT
        d_M3 = tokens_GM[3:6].mT
        moment_nM3 = torch.linalg.cross(center_n3[:, None], d_M3[None], dim=-1) - m_M3
        return clamped(-factor_n1 * moment_nM3.square().sum(-1), lower_n1)

    def compiled(self) -> tuple[Kernel, Kernel]:
        from qgs_locus.kernels import ray_bias_numba as kernels  # needs numba

        return kernels.write, kernels.gradients


def clamped(bias_nM: Tensor, lower_n1: Tensor) -> Tensor:
    """Return max(bias, lower); where the bound is reached, the gradient goes to `lower_n1`."""
    # The condition is false for NaN, so that NaN stays.
    return torch.where(bias_nM <= lower_n1, lower_n1, bias_nM)

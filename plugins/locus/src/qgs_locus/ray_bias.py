"""The attention bias between anchors and image rays: b = -1/2 (D / sigma)^2.

D = |mu x d - m| is the distance of an anchor's centre mu to the line of a Plücker ray (m, d). It is
computed as written, in float32: as a product of features of mu and of the ray it would be a small
difference of numbers that grow with |mu|^2, off by several logits far from the cameras.
"""

from typing import Any, Self

import torch
from torch import Tensor

from qgs.components import AttentionBias, Kernel
from qgs.geometry.precision import full_precision
from qgs.geometry.rays import normalised_rays


@full_precision
def ray_tokens(rays_BM6: Tensor, direction_eps: float = 1e-6) -> Tensor:
    """Moments and directions as rows: (B, M, 6) -> (B, 6, M).

    direction_eps: least |d| that a ray is divided by.
    """
    return torch.cat(normalised_rays(rays_BM6, direction_eps), -1).mT.contiguous()


class RayBias(AttentionBias):
    """gamma * clamp(-D^2 / (2 sigma^2), bias_min, 0).

    Reads of a query mu, gamma / (2 sigma^2) and gamma * bias_min; of a token m and d.
    """

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
        """sigma_sq: (B, N, 1) or a number. tokens: `ray_tokens`, the same for all layers.

        gamma: 0-d, positive.
        """
        each_BN1 = torch.ones_like(center_BN3[..., :1])
        parts = [center_BN3, each_BN1 * (gamma / (2 * sigma_sq)), each_BN1 * (gamma * bias_min)]
        return cls(torch.cat(parts, -1), tokens_B6M)

    def value(self, queries_nF: Tensor, tokens_GM: Tensor) -> Tensor:
        """(n, M), through (n, M, 3) cross products."""
        center_n3, factor_n1, lower_n1 = queries_nF.split([3, 1, 1], -1)
        m_M3, d_M3 = tokens_GM[:3].mT, tokens_GM[3:6].mT
        moment_nM3 = torch.linalg.cross(center_n3[:, None], d_M3[None], dim=-1) - m_M3
        return clamped(-factor_n1 * moment_nM3.square().sum(-1), lower_n1)

    def compiled(self) -> tuple[Kernel, Kernel]:
        """Of `ray_bias_kernels`."""
        from qgs_locus import ray_bias_kernels as kernels  # needs numba

        return kernels.write, kernels.gradients

    def triton_functions(self) -> tuple[Any, Any]:
        """Of `ray_bias_triton`."""
        from qgs_locus import ray_bias_triton as functions  # needs triton

        return functions.value, functions.gradients


def clamped(bias_nM: Tensor, lower_n1: Tensor) -> Tensor:
    """At least `lower_n1`, to which the gradient goes where it is reached."""
    return torch.where(bias_nM <= lower_n1, lower_n1, bias_nM)  # so that NaN stays

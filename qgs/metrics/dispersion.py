"""How far the Gaussians of one token scatter (LocusGS)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from qgs.geometry.precision import full_precision


@full_precision
def token_dispersion(means: Tensor, gaussians_per_query: int) -> Tensor:
    """Distance of each Gaussian to the centroid of its token's, world units.

    means: (B, N * K, 3) ordered query by query -> (B, N * K). The published figure is the mean over
    Gaussians; the median is not ruled by a few far ones.
    Raises ValueError when K does not divide the number of Gaussians.
    """
    if means.shape[-2] % gaussians_per_query:
        raise ValueError(
            f"{means.shape[-2]} Gaussians cannot be shared out to tokens of {gaussians_per_query}"
        )
    tokens = means.unflatten(-2, (-1, gaussians_per_query))
    return (tokens - tokens.mean(-2, keepdim=True)).norm(dim=-1).flatten(-2)


@dataclass(frozen=True)
class Spread:
    """Mean, variance (over the population) and median of a figure over scenes."""

    mean: float
    variance: float
    median: float


def spread(values: Tensor) -> Spread:
    """Summary of one figure per scene, values (S,). Raises ValueError for no scene at all."""
    if not values.numel():
        raise ValueError("there is no scene to summarise")
    values = values.double()
    return Spread(
        float(values.mean()), float(values.var(correction=0)), float(values.quantile(0.5))
    )


def median(values: Tensor) -> Tensor:
    """Median over the last dimension, the mean of the middle two for an even count."""
    return torch.quantile(values, 0.5, dim=-1)


OPACITY_USED = 1 / 255
"""A Gaussian of lower opacity is never drawn: renderers skip alpha below 1/255."""


def gaussians_used(opacities: Tensor) -> Tensor:
    """How many of opacities (..., G) are above OPACITY_USED -> (...)."""
    return (opacities > OPACITY_USED).sum(-1)

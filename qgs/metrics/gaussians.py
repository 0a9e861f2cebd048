"""How many of its Gaussians a reconstruction uses."""

from __future__ import annotations

from torch import Tensor

OPACITY_USED = 1 / 255
"""A Gaussian of lower opacity is never drawn: renderers skip alpha below 1/255."""


def gaussians_used(opacities: Tensor) -> Tensor:
    """How many of opacities (..., G) are above OPACITY_USED -> (...)."""
    return (opacities > OPACITY_USED).sum(-1)

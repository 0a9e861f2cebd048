"""State fields of an anchor, and the map from its raw radius to its radius."""

import math
from typing import Literal

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from qgs.contracts import ComponentConfig, Fields, FieldSpec
from qgs.precision import full_precision
from qgs.types import SpatialSupport

CENTER = "anchor.center"
RAW_RADIUS = "anchor.raw_radius"

CENTER_FIELD: Fields = {CENTER: FieldSpec((3,), frame="world")}
"""Anchor centre mu (B, N, 3), unbounded."""

RAW_LEAST = 1e-6
"""Lower bound of softplus(rho) where rho is computed from a radius, so that rho is finite."""


class RadiusOptions(ComponentConfig):
    """Options that map the raw radius rho to the support radius r; all components must agree."""

    radius_bound: Literal["floor", "offset"] = "floor"
    """Use r = max(softplus(rho), radius_min) ("floor", release) or r = softplus(rho) + radius_min
    ("offset", paper). It must be the same in all components."""
    radius_min: float = Field(default=1e-3, ge=0)
    """Least support radius, world units. It must be the same in all components."""


def radius_field(options: RadiusOptions) -> Fields:
    """Return the field of raw radii rho (B, N, 1).

    Its encoding lets the composer refuse components that disagree about the options.
    """
    reading = {
        "floor": f"radius = max(softplus(x), {options.radius_min:g})",
        "offset": f"radius = softplus(x) + {options.radius_min:g}",
    }
    return {RAW_RADIUS: FieldSpec((1,), frame="world", encoding=reading[options.radius_bound])}


@full_precision
def support_radius(raw_radius: Tensor, options: RadiusOptions) -> Tensor:
    """Return support radii r > 0, world units, for raw radii of any shape: equation (1)."""
    radius = F.softplus(raw_radius)
    # Softplus can be almost 0, and equation (3) divides by r.
    if options.radius_bound == "floor":
        return radius.clamp_min(options.radius_min)
    return radius + options.radius_min


def raw_radius_of(radius: float) -> float:
    """Return rho with softplus(rho) = `radius` > 0."""
    return radius + math.log(-math.expm1(-radius))


@full_precision
def raw_radii(radii: Tensor, options: RadiusOptions) -> Tensor:
    """Return the raw radii for which `support_radius` gives `radii`.

    Radii below the least possible one are raised to it.
    """
    least = options.radius_min if options.radius_bound == "offset" else 0.0
    # softplus^-1(y) = y + log(1 - exp(-y)), which stays exact for large y.
    softplus = (radii - least).clamp_min(RAW_LEAST)
    return softplus + (-torch.expm1(-softplus)).log()


def ball_support(centers: Tensor, radii: Tensor) -> SpatialSupport:
    """Return balls with centres (B, N, 3) and radii (B, N, 1)."""
    return SpatialSupport(centers=centers, axes=radii[..., None] * torch.eye(3).to(centers))

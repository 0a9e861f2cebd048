"""State fields of an anchor, and the map from its raw radius to its radius."""

import math
from typing import Literal

import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat
from torch import Tensor

from qgs.contracts import ComponentConfig, Fields, FieldSpec
from qgs.precision import full_precision
from qgs.types import SpatialSupport

CENTER = "anchor.center"
RAW_RADIUS = "anchor.raw_radius"

CENTER_FIELD: Fields = {CENTER: FieldSpec((3,), frame="world")}
"""Field of anchor centres mu (B, N, 3), world frame, unbounded."""

RAW_LEAST = 1e-6
"""Lower bound of softplus(rho) when rho is computed from a radius. It keeps rho finite."""


class RadiusOptions(ComponentConfig):
    """Options of the map from the raw radius rho to the support radius r of an anchor."""

    radius_bound: Literal["floor", "offset"] = "floor"
    """Support radius r = max(softplus(rho), radius_min) ("floor", LocusGS release) or r =
    softplus(rho) + radius_min ("offset", paper). All components with this option must have the same
    value."""
    radius_min: NonNegativeFloat = 1e-3
    """Least support radius, world units. All components with this option must have the same
    value."""


def radius_field(options: RadiusOptions) -> Fields:
    """Return the state field of raw radii rho (B, N, 1).

    The field's `encoding` holds the values of `radius_bound` and `radius_min`, so a recipe is
    refused if two of its components have different values.
    """
    reading = {
        "floor": f"radius = max(softplus(x), {options.radius_min:g})",
        "offset": f"radius = softplus(x) + {options.radius_min:g}",
    }
    return {RAW_RADIUS: FieldSpec((1,), frame="world", encoding=reading[options.radius_bound])}


@full_precision
def support_radius(raw_radius: Tensor, options: RadiusOptions) -> Tensor:
    """Return support radii r > 0, world units, for raw radii of any shape.

    This is equation (1) of the plugin's README.
    """
    radius = F.softplus(raw_radius)
    # Softplus can be almost 0, and equation (3) divides by r.
    if options.radius_bound == "floor":
        return radius.clamp_min(options.radius_min)
    return radius + options.radius_min


def raw_radius_of(radius: float) -> float:
    """Return the raw radius rho for which softplus(rho) is `radius`, a positive number."""
    return radius + math.log(-math.expm1(-radius))


@full_precision
def raw_radii(radii: Tensor, options: RadiusOptions) -> Tensor:
    """Return the raw radii for which `support_radius` gives `radii`.

    Radii below the least possible radius are raised to the least one.
    """
    least = options.radius_min if options.radius_bound == "offset" else 0.0
    # softplus^-1(y) = y + log(1 - exp(-y)), which stays exact for large y.
    softplus = (radii - least).clamp_min(RAW_LEAST)
    return softplus + (-torch.expm1(-softplus)).log()


def ball_support(centers: Tensor, radii: Tensor) -> SpatialSupport:
    """Return balls with centres (B, N, 3) and radii (B, N, 1), world units."""
    return SpatialSupport(centers=centers, axes=radii[..., None] * torch.eye(3).to(centers))

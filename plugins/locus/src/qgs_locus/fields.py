"""The state fields of an anchor, and how its radius follows from the raw radius."""

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
"""Unbounded anchor centre mu (B, N, 3)."""

RAW_LEAST = 1e-6
"""Least softplus of a raw radius that is made from a radius, so that the raw one is finite."""


class RadiusOptions(ComponentConfig):
    """How the support radius r follows from the raw radius rho; all components must agree."""

    radius_bound: Literal["floor", "offset"] = "floor"
    """r = max(softplus(rho), radius_min) ("floor", release) or softplus(rho) + radius_min (paper);
    the same in all components."""
    radius_min: float = Field(default=1e-3, ge=0)
    """Least support radius, world units; the same in all components."""


def radius_field(options: RadiusOptions) -> Fields:
    """Raw radius rho (B, N, 1); the encoding lets the composer refuse components that disagree."""
    reading = {
        "floor": f"radius = max(softplus(x), {options.radius_min:g})",
        "offset": f"radius = softplus(x) + {options.radius_min:g}",
    }
    return {RAW_RADIUS: FieldSpec((1,), frame="world", encoding=reading[options.radius_bound])}


@full_precision
def support_radius(raw_radius: Tensor, options: RadiusOptions) -> Tensor:
    """Support radii r > 0, world units, of raw radii of any shape: equation (1)."""
    radius = F.softplus(raw_radius)
    # Softplus comes near 0, and r divides in equation (3)
    if options.radius_bound == "floor":
        return radius.clamp_min(options.radius_min)
    return radius + options.radius_min


def raw_radius_of(radius: float) -> float:
    """softplus^-1: the rho whose softplus is `radius` > 0."""
    return radius + math.log(-math.expm1(-radius))


@full_precision
def raw_radii(radii: Tensor, options: RadiusOptions) -> Tensor:
    """The raw radii of which `support_radius` makes `radii`, which are raised to the least one."""
    least = options.radius_min if options.radius_bound == "offset" else 0.0
    # softplus^-1(y) = y + log(1 - exp(-y)), which stays exact for large y.
    softplus = (radii - least).clamp_min(RAW_LEAST)
    return softplus + (-torch.expm1(-softplus)).log()


def ball_support(centers: Tensor, radii: Tensor) -> SpatialSupport:
    """Balls around centres (B, N, 3), of radii (B, N, 1)."""
    return SpatialSupport(centers=centers, axes=radii[..., None] * torch.eye(3).to(centers))

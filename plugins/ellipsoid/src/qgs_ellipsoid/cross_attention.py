"""`ellipsoid/ray_biased`: queries look first at the rays that pass through their ellipsoid."""

from __future__ import annotations

from typing import ClassVar

from qgs_locus.cross_attention import RayBiasedCrossAttention
from qgs_locus.fields import CENTER, RAW_RADIUS, support_radius
from torch import Tensor

from qgs.contracts import Fields
from qgs.types import ImageMemory, QueryState
from qgs_ellipsoid.fields import RAW_RADII, ROTATION, anchor_rotation, shape_fields
from qgs_ellipsoid.ray_bias import ellipsoid_bias, ray_features


class EllipsoidCrossAttention(RayBiasedCrossAttention):
    """`locus/ray_biased` whose bias measures a ray's distance in the metric of the anchor.

    Its options, floors, clamp and gamma are LocusGS's; the floor of (sigma0 r)^2 holds along each
    axis, and a fixed bandwidth knows no shape.
    """

    name: ClassVar[str] = "ray_biased"

    @classmethod
    def requires(cls, config: RayBiasedCrossAttention.Config) -> Fields:
        """Those of `locus/ray_biased`, with a shape for its radius."""
        shape = shape_fields(config) if config.bandwidth == "radius" else {}
        return {n: f for n, f in super().requires(config).items() if n != RAW_RADIUS} | dict(shape)

    def sigma_sq(self, state: QueryState) -> Tensor | float:
        """Squared bandwidths along the axes of each anchor (B, N, 3), or one number when fixed."""
        if self.config.bandwidth == "fixed":
            return super().sigma_sq(state)
        radii = support_radius(state[RAW_RADII], self.config)
        return (self.config.sigma0 * radii).square().clamp_min(self.config.sigma_sq_min)

    def bias(self, state: QueryState, memory: ImageMemory) -> Tensor:
        """gamma b (B, N, M), float32, computed from the state that enters the layer."""
        config, sigma_sq = self.config, self.sigma_sq(state)
        if not isinstance(sigma_sq, Tensor):
            return super().bias(state, memory)
        features = memory.once(
            f"ellipsoid.ray_features.{config.direction_eps:g}",
            lambda: ray_features(memory.patch_rays, config.direction_eps),
        )
        rotation = anchor_rotation(state[ROTATION])
        return ellipsoid_bias(
            state[CENTER], rotation, sigma_sq, features, config.bias_min, self.gamma
        )

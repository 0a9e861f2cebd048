"""`ellipsoid/ray_biased`: queries attend more to rays that pass through their ellipsoid."""

from qgs_locus.cross_attention import RayBiasedCrossAttention
from qgs_locus.fields import CENTER
from qgs_locus.kernels.attention_bias import AttentionBias
from torch import Tensor

from qgs.contracts import Fields
from qgs.types import ImageMemory, QueryState
from qgs_anchors.ellipsoid.fields import RAW_RADII, ROTATION, anchor_rotation, shape_fields
from qgs_anchors.ellipsoid.ray_bias import EllipsoidBias, ray_tokens


class EllipsoidCrossAttention(RayBiasedCrossAttention):
    """`locus/ray_biased` whose bias measures a ray's distance in the metric of the anchor.

    Options, floors, clamp and gamma are LocusGS's. The floor of (sigma0 r)^2 holds along each axis;
    a fixed bandwidth ignores the shape.
    """

    name = "ray_biased"
    raw_radius = RAW_RADII

    @classmethod
    def bandwidth_fields(cls, config: RayBiasedCrossAttention.Config) -> Fields:
        return shape_fields(config) if config.bandwidth == "radius" else {}

    def bias(self, state: QueryState, memory: ImageMemory) -> AttentionBias:
        """gamma b, of the state before this layer."""
        config = self.config
        sigma_sq_BN3 = self.sigma_sq(state)
        # One bandwidth for all anchors is that of a ball: LocusGS's kernels are shorter.
        if not isinstance(sigma_sq_BN3, Tensor):
            return super().bias(state, memory)
        # Made once a pass: all layers read the same rays.
        tokens_B9M = memory.once(
            f"ellipsoid.ray_tokens.{config.direction_eps:g}",
            lambda: ray_tokens(memory["patch_rays"], config.direction_eps),
        )
        place = state[CENTER], anchor_rotation(state[ROTATION]), sigma_sq_BN3
        return EllipsoidBias.of(*place, tokens_B9M, config.bias_min, self.gamma)

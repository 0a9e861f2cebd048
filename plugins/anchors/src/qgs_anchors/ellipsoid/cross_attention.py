"""`ellipsoid/ray_biased`: attention that prefers patches with rays through a query's ellipsoid."""

from qgs_locus.cross_attention import RayBiasedCrossAttention
from qgs_locus.fields import CENTER
from qgs_locus.kernels.attention_bias import AttentionBias
from torch import Tensor

from qgs.contracts import Fields
from qgs.types import ImageMemory, QueryState
from qgs_anchors.ellipsoid.fields import RAW_RADII, ROTATION, anchor_rotation, shape_fields
from qgs_anchors.ellipsoid.ray_bias import EllipsoidBias, ray_tokens


class EllipsoidCrossAttention(RayBiasedCrossAttention):
    """Attention `locus/ray_biased` with an ellipsoid instead of a ball around the anchor's centre.

    Before the distance from the centre to a ray is computed, the coordinate along each axis of the
    ellipsoid is divided by the radius along this axis. Options mean the same as in
    `locus/ray_biased`; `sigma_sq_min` is the lower bound of (sigma0 r)^2 for the radius r of each
    axis. With `bandwidth: fixed` the ellipsoid has no effect.
    """

    name = "ray_biased"
    raw_radius = RAW_RADII

    @classmethod
    def bandwidth_fields(cls, config: RayBiasedCrossAttention.Config) -> Fields:
        return shape_fields(config) if config.bandwidth == "radius" else {}

    def bias(self, state: QueryState, memory: ImageMemory) -> AttentionBias:
        """Return the bias of attention logits, from anchors in `state` and rays in `memory`."""
        config = self.config
        sigma_sq_BN3 = self.sigma_sq(state)
        # With one bandwidth for all anchors, the bias is that of LocusGS, whose kernels are faster.
        if not isinstance(sigma_sq_BN3, Tensor):
            return super().bias(state, memory)
        # Computed once a pass: all layers read the same rays.
        tokens_B9M = memory.once(
            f"ellipsoid.ray_tokens.{config.direction_eps:g}",
            lambda: ray_tokens(memory["patch_rays"], config.direction_eps),
        )
        place = state[CENTER], anchor_rotation(state[ROTATION]), sigma_sq_BN3
        return EllipsoidBias.of(*place, tokens_B9M, config.bias_min, self.gamma)

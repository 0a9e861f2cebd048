"""`locus/ray_biased`: attention that prefers image patches whose rays pass near the anchor."""

from collections.abc import Iterable
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from pydantic import NegativeFloat, PositiveFloat
from torch import Tensor, nn

from qgs.contracts import (
    AttentionWeights,
    Fields,
    ModelDims,
    Problem,
    RecipeContext,
    memory_fields,
    without_effect,
)
from qgs.tokengs import ContentCrossAttention
from qgs.tokengs.blocks import attention_weights, merge_heads
from qgs.types import ImageMemory, QueryState
from qgs_locus.fields import (
    CENTER,
    CENTER_FIELD,
    RAW_RADIUS,
    RadiusOptions,
    radius_field,
    support_radius,
)
from qgs_locus.kernels.attention_bias import AttentionBias, biased_attention
from qgs_locus.ray_bias import RayBias, ray_tokens


class RayBiasedCrossAttention(ContentCrossAttention):
    """Cross-attention that prefers image patches whose rays pass near the query's anchor.

    It computes softmax(q k / sqrt(d) + gamma b) v with the bias b = -1/2 (D / sigma)^2. D is the
    distance from the patch's ray to the anchor's centre. `bandwidth` sets sigma; gamma > 0 is
    learned. All heads share the bias. This is equation (4) of the plugin's README.
    """

    name = "ray_biased"
    raw_radius = RAW_RADIUS
    # Another anchor has other fields, which the bandwidth depends on unless it is fixed.
    fields_of_radius = staticmethod(radius_field)
    reads: ClassVar[Fields] = {**memory_fields("keys", "values", "patch_rays"), **CENTER_FIELD}

    class Config(RadiusOptions, ContentCrossAttention.Config):
        bandwidth: Literal["radius", "fixed"] = "radius"
        """Bandwidth sigma of the bias: `sigma0` times the anchor's radius ("radius"), or `sigma0`
        for all anchors ("fixed")."""
        sigma0: PositiveFloat = 0.1
        """Bandwidth sigma as a multiple of the anchor's radius. With `bandwidth: fixed`, sigma
        itself, world units."""
        sigma_sq_min: PositiveFloat = 1e-3
        """Lower bound of sigma^2 = (sigma0 r)^2, world units squared. r is the anchor's
        radius."""
        bias_min: NegativeFloat = -20.0
        """Lower bound of the bias b, before it is multiplied by gamma."""
        direction_eps: PositiveFloat = 1e-6
        """Lower bound of the length by which a patch's mean ray direction is divided to normalise
        it."""
        gamma_init: float = -2.25
        """Initial value of the learned g of each layer. The bias is multiplied by
        gamma = softplus(g)."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        # Stored before softplus: training can weaken the bias, but never turn it into a repulsion.
        self.raw_gamma = nn.Parameter(torch.tensor(config.gamma_init))

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        radius = cls.fields_of_radius(config) if config.bandwidth == "radius" else {}
        return {**cls.reads, **radius}

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Report radius options that have no effect because the bandwidth is fixed."""
        if config.bandwidth == "fixed":
            idle = ("sigma_sq_min", "radius_bound", "radius_min")
            yield from without_effect(config, idle, "`bandwidth` is fixed")

    @property
    def gamma(self) -> Tensor:
        """Positive weight gamma of the bias, 0-d."""
        return F.softplus(self.raw_gamma)

    def sigma_sq(self, state: QueryState) -> Tensor | float:
        """Return sigma^2, world units squared: (B, N, 1), or one number if sigma is fixed."""
        if self.config.bandwidth == "fixed":
            return self.config.sigma0**2
        r_BN1 = support_radius(state[self.raw_radius], self.config)
        # The floor lets a shrinking anchor still reach some ray, and keeps 1 / sigma^2 finite.
        return (self.config.sigma0 * r_BN1).square().clamp_min(self.config.sigma_sq_min)

    def bias(self, state: QueryState, memory: ImageMemory) -> AttentionBias:
        """Return the bias of attention logits, from anchors in `state` and rays in `memory`."""
        config = self.config
        eps = config.direction_eps
        # The rays of a scene are the same in all layers.
        rays_B6M = memory.once(
            f"locus.ray_tokens.{eps:g}", lambda: ray_tokens(memory["patch_rays"], eps)
        )
        sigma_sq = self.sigma_sq(state)
        return RayBias.of(state[CENTER], sigma_sq, rays_B6M, config.bias_min, self.gamma)

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        q_BhNd = self.core.project(state.features)
        v_BhMd = memory["values"]
        # As in `CrossAttentionCore`: norms give float32 under autocast.
        q_BhNd = q_BhNd.to(v_BhMd.dtype)
        k_BhMd = memory["keys"].to(v_BhMd.dtype)
        read_BhNd = biased_attention(q_BhNd, k_BhMd, v_BhMd, self.bias(state, memory))
        return self.core.out_proj(merge_heads(read_BhNd))

    def explain(self, state: QueryState, memory: ImageMemory, queries: Tensor) -> AttentionWeights:
        # Norms run over channels, so selecting queries after the projection is exact.
        q_BhQd = self.core.project(state.features)[:, :, queries]
        bias_BQM = self.bias(state, memory).dense(queries)
        return attention_weights(q_BhQd, memory["keys"], bias_BQM[:, None])

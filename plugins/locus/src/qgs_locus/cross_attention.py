"""`locus/ray_biased`: queries attend more to rays that pass near their anchor."""

from collections.abc import Iterable
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

from qgs.contracts import (
    AttentionWeights,
    CrossAttention,
    Fields,
    ModelDims,
    Problem,
    RecipeContext,
    memory_fields,
    without_effect,
)
from qgs.tokengs import NORM_EPS, CrossAttentionCore
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


class RayBiasedCrossAttention(CrossAttention):
    """By content, and by the distance D of a patch's ray to the anchor (LocusGS), equation (4).

    softmax(q k / sqrt(d) + gamma b) v, b = -1/2 (D / sigma)^2. sigma = sigma0 r ("radius"), or
    sigma0 ("fixed"). The bias is the same for all heads.
    """

    name = "ray_biased"
    raw_radius = RAW_RADIUS
    reads: ClassVar[Fields] = {**memory_fields("keys", "values", "patch_rays"), **CENTER_FIELD}

    class Config(RadiusOptions):
        bandwidth: Literal["radius", "fixed"] = "radius"
        """sigma is `sigma0` times the anchor's radius, or `sigma0` for every anchor ("fixed")."""
        sigma0: float = Field(default=0.1, gt=0)
        """Bandwidth per radius, or the bandwidth in world units if it is fixed."""
        sigma_sq_min: float = Field(default=1e-3, gt=0)
        """Least (sigma0 r)^2, world units squared."""
        bias_min: float = Field(default=-20.0, lt=0)
        """Lower clamp of the bias b, before gamma."""
        direction_eps: float = Field(default=1e-6, gt=0)
        """Least length that the mean direction of a patch is divided by."""
        gamma_init: float = -2.25
        """Initial g of each layer; the weight of the bias is gamma = softplus(g)."""
        norm_eps: float = Field(default=NORM_EPS, gt=0)
        """Added to the variance by every LayerNorm."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.core = CrossAttentionCore(dims.width, dims.heads, config.norm_eps)
        # Before softplus, as the radius: the bias may be turned down, never into a repulsion.
        self.raw_gamma = nn.Parameter(torch.tensor(config.gamma_init))

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        """Radii too if the bandwidth follows them."""
        return {**cls.reads, **cls.bandwidth_fields(config)}

    @classmethod
    def bandwidth_fields(cls, config: Config) -> Fields:
        """What a bandwidth that follows the anchor's size reads of it."""
        return radius_field(config) if config.bandwidth == "radius" else {}

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Options of a radius that a fixed bandwidth does not read."""
        if config.bandwidth == "fixed":
            idle = ("sigma_sq_min", "radius_bound", "radius_min")
            yield from without_effect(config, idle, "`bandwidth` is fixed")

    @property
    def gamma(self) -> Tensor:
        """Weight of the bias, 0-d, positive."""
        return F.softplus(self.raw_gamma)

    def sigma_sq(self, state: QueryState) -> Tensor | float:
        """Squared bandwidth: (B, N, 1), or one number when fixed."""
        if self.config.bandwidth == "fixed":
            return self.config.sigma0**2
        r_BN1 = support_radius(state[self.raw_radius], self.config)
        # The floor keeps an anchor that shrinks in sight of some ray, and 1 / sigma^2 finite.
        return (self.config.sigma0 * r_BN1).square().clamp_min(self.config.sigma_sq_min)

    def bias(self, state: QueryState, memory: ImageMemory) -> AttentionBias:
        """gamma b, of the state before this layer."""
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
        # Norms are over channels, so choosing queries after the projection is exact.
        q_BhQd = self.core.project(state.features)[:, :, queries]
        bias_BQM = self.bias(state, memory).dense(queries)
        return attention_weights(q_BhQd, memory["keys"], bias_BQM[:, None])

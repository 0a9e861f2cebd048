"""`locus/anchor_aware`: queries exchange what they know, knowing where they are."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from qgs.components import Mlp, SelfAttentionCore
from qgs.contracts import AttentionWeights, ComponentConfig, Fields, ModelDims, SelfAttention
from qgs.geometry.precision import full_precision
from qgs.types import QueryState
from qgs_locus.fields import CENTER, CENTER_FIELD

FEATURES_PER_AXIS = 128
TEMPERATURE = 10_000.0


@full_precision
def sine_embedding(position: Tensor) -> Tensor:
    """Sine features of positions in [-1, 1]: (..., 3) -> (..., 384), axis by axis.

    Each axis is mapped to [0, 2 pi] and divided by T^(2i/128) + 1e-6; sine and cosine interleave
    (LocusGS release).
    """
    half = torch.arange(FEATURES_PER_AXIS // 2, dtype=position.dtype, device=position.device)
    divisor = TEMPERATURE ** (2 * half / FEATURES_PER_AXIS) + 1e-6
    angle = ((position + 1) * math.pi)[..., None] / divisor
    return torch.stack([angle.sin(), angle.cos()], -1).flatten(-3)


class AnchorAwareSelfAttention(SelfAttention):
    """Self-attention over x + p with p = MLP(PE(mu)); queries, keys and values all see p.

    The residual stream itself does not keep p.
    """

    name: ClassVar[str] = "anchor_aware"

    class Config(ComponentConfig):
        """position: what is embedded, "tanh" of the centre (release) or "raw" (paper)."""

        position: Literal["tanh", "raw"] = "tanh"

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.norm = nn.LayerNorm(dims.width)
        self.attention = SelfAttentionCore(dims.width, dims.heads)
        self.position_mlp = Mlp(3 * FEATURES_PER_AXIS, dims.width, dims.width)

    @classmethod
    def requires(cls, config: Config) -> Fields:
        """Centres."""
        return CENTER_FIELD

    def position_embedding(self, state: QueryState) -> Tensor:
        """p (B, N, D)."""
        center = state[CENTER]
        position = torch.tanh(center) if self.config.position == "tanh" else center
        return self.position_mlp(sine_embedding(position))

    def forward(self, state: QueryState) -> Tensor:
        """The update (B, N, D)."""
        return self.attention(self.norm(state.features + self.position_embedding(state)))

    def explain(self, state: QueryState, queries: Tensor) -> AttentionWeights:
        """Attention over queries."""
        normed = self.norm(state.features + self.position_embedding(state))
        return self.attention.explain(normed, queries)

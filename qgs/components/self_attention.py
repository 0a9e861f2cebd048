"""`qgs/content`: queries attend to each other by content alone (TokenGS)."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field
from torch import Tensor, nn

from qgs.components.blocks import NORM_EPS, SelfAttentionCore
from qgs.contracts import AttentionWeights, ComponentConfig, ModelDims, SelfAttention
from qgs.types import QueryState


class ContentSelfAttention(SelfAttention):
    """Pre-norm self-attention over the N queries of a scene."""

    name: ClassVar[str] = "content"

    class Config(ComponentConfig):
        """norm_eps: of every LayerNorm."""

        norm_eps: float = Field(default=NORM_EPS, gt=0)

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.norm = nn.LayerNorm(dims.width, config.norm_eps)
        self.attention = SelfAttentionCore(dims.width, dims.heads, config.norm_eps)

    def forward(self, state: QueryState) -> Tensor:
        """The update (B, N, D)."""
        return self.attention(self.norm(state.features))

    def explain(self, state: QueryState, queries: Tensor) -> AttentionWeights:
        """Attention over queries."""
        return self.attention.explain(self.norm(state.features), queries)

"""`qgs/content`: queries read the images by content alone (TokenGS)."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field
from torch import Tensor

from qgs.components.blocks import NORM_EPS, CrossAttentionCore
from qgs.contracts import AttentionWeights, ComponentConfig, CrossAttention, ModelDims
from qgs.contracts.component import Fields
from qgs.contracts.encoder import MEMORY_FIELDS
from qgs.types import ImageMemory, QueryState


class ContentCrossAttention(CrossAttention):
    """softmax(q k / sqrt(d)) v over all image tokens."""

    name: ClassVar[str] = "content"

    class Config(ComponentConfig):
        """norm_eps: of every LayerNorm."""

        norm_eps: float = Field(default=NORM_EPS, gt=0)

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.core = CrossAttentionCore(dims.width, dims.heads, config.norm_eps)

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        """Keys and values."""
        return {name: MEMORY_FIELDS[name] for name in ("memory.keys", "memory.values")}

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        """The update (B, N, D)."""
        return self.core(state.features, memory.keys, memory.values)

    def explain(self, state: QueryState, memory: ImageMemory, queries: Tensor) -> AttentionWeights:
        """Attention over image tokens."""
        return self.core.explain(state.features, memory.keys, queries)

"""Components that know how wide and many-headed a model is, whatever they are told."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor, nn

from qgs.components import ContentCrossAttention, CrossAttentionCore, MlpFeedForward
from qgs.contracts import ModelDims


class KnowsTwoHeads(ContentCrossAttention):
    name: ClassVar[str] = "knows_two_heads"

    def __init__(self, config: ContentCrossAttention.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.core = CrossAttentionCore(dims.width, 2, config.norm_eps)


class KnowsItsWidth(MlpFeedForward):
    name: ClassVar[str] = "knows_its_width"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.out = nn.Linear(dims.width, 32)

    def forward(self, features: Tensor) -> Tensor:
        return self.out(super().forward(features))

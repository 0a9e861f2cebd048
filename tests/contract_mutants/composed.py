"""Components that run alone, on inputs of their own, and fail or lie beside others."""

from __future__ import annotations

from typing import ClassVar

import torch
from contract_mutants.modules import PLACE
from torch import Tensor, nn

from qgs.components import ContentCrossAttention, ContentSelfAttention
from qgs.components.blocks import CrossAttentionCore, split_heads
from qgs.contracts import (
    MEMORY_FIELDS,
    AttentionWeights,
    ComponentConfig,
    CrossAttention,
    Fields,
    ModelDims,
)
from qgs.types import ImageMemory, QueryState


class ViewsAField(ContentSelfAttention):
    """Takes a field for contiguous; queries expand theirs to all scenes."""

    name: ClassVar[str] = "views_a_field"

    def __init__(self, config: ContentSelfAttention.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.place = nn.Linear(3, dims.width)

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        return PLACE

    def forward(self, state: QueryState) -> Tensor:
        center = state["place.center"]
        place = self.place(center.view(-1, 3)).view(*center.shape[:2], -1)
        return self.attention(self.norm(state.features + place))


class SharesItsProjection(CrossAttention):
    """Keys and values by the weights of whichever layer comes first."""

    name: ClassVar[str] = "shares_its_projection"

    def __init__(self, config: ComponentConfig, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.core = CrossAttentionCore(dims.width, dims.heads)
        self.kv = nn.Linear(dims.width, 2 * dims.width)

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        return {"memory.features": MEMORY_FIELDS["memory.features"]}

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        both = memory.once("mutants.kv", lambda: self.kv(memory.features))
        keys, values = (split_heads(x, self.dims.heads) for x in both.chunk(2, -1))
        return self.core(state.features, keys, values)


class KeepsTheFirstState(ContentCrossAttention):
    name: ClassVar[str] = "keeps_the_first_state"

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        mean = memory.once("mutants.mean", lambda: state.features.mean(1, keepdim=True))
        return super().forward(state, memory) + mean


class ExplainsNoBias(ContentCrossAttention):
    """What it tells of itself leaves out what geometry adds."""

    name: ClassVar[str] = "explains_no_bias"

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        memory = ("memory.keys", "memory.values", "memory.patch_rays")
        return {**PLACE, **{name: MEMORY_FIELDS[name] for name in memory}}

    def bias(self, state: QueryState, memory: ImageMemory) -> Tensor:
        apart = state["place.center"][:, :, None] - memory.patch_rays[:, None, :, 3:]
        return -apart.square().sum(-1)

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        bias = self.bias(state, memory)
        return self.core(state.features, memory.keys, memory.values, bias)

    def explain(self, state: QueryState, memory: ImageMemory, queries: Tensor) -> AttentionWeights:
        return self.core.explain(state.features, memory.keys, queries)


class BiasesInHalfUntold(ExplainsNoBias):
    """Geometry in bfloat16 that nothing but the update shows."""

    name: ClassVar[str] = "biases_in_half_untold"

    def bias(self, state: QueryState, memory: ImageMemory) -> Tensor:
        center, directions = state["place.center"], memory.patch_rays[..., 3:]
        return (center @ directions.transpose(-1, -2)).to(center)

    def explain(self, state: QueryState, memory: ImageMemory, queries: Tensor) -> None:
        return None


class ExplainsWithoutSoftmax(ContentSelfAttention):
    name: ClassVar[str] = "explains_without_softmax"

    def explain(self, state: QueryState, queries: Tensor) -> AttentionWeights:
        told = super().explain(state, queries)
        return AttentionWeights(told.content, None, torch.sigmoid(told.content))

"""Components that keep the contract in ways that a check could take for a fault."""

from __future__ import annotations

from typing import ClassVar

import torch
import torch.nn.functional as F
from contract_mutants.modules import PLACE
from torch import Tensor, nn

from qgs.components import ContentCrossAttention, ContentSelfAttention
from qgs.components.blocks import merge_heads
from qgs.contracts import ComponentConfig, FeedForward, Fields, ModelDims, SelfAttention
from qgs.losses import Opacity
from qgs.types import ImageMemory, QueryState


class TurnsAutocastOff(ContentSelfAttention):
    """PyTorch's own idiom for float32 geometry, which torch refuses on meta."""

    name: ClassVar[str] = "turns_autocast_off"

    def __init__(self, config: ContentSelfAttention.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.place = nn.Linear(3, dims.width)

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        return PLACE

    def forward(self, state: QueryState) -> Tensor:
        center = state["place.center"]
        with torch.autocast(center.device.type, enabled=False):
            bounded = center / (1 + center.norm(dim=-1, keepdim=True))
        return self.attention(self.norm(state.features + self.place(bounded)))


class FusesInHalf(ContentCrossAttention):
    """Attention by one kernel in half precision, spelled out in any other."""

    name: ClassVar[str] = "fuses_in_half"

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        keys, values = memory.keys, memory.values
        query = self.core.project(state.features).to(values.dtype)
        if values.dtype == torch.bfloat16:
            read = F.scaled_dot_product_attention(query, keys, values)
        else:
            read = (query @ keys.mT * query.shape[-1] ** -0.5).softmax(-1) @ values
        return self.core.out_proj(merge_heads(read))


class LooksNowhere(SelfAttention):
    """The ablation of a slot: queries exchange nothing."""

    name: ClassVar[str] = "looks_nowhere"

    def forward(self, state: QueryState) -> Tensor:
        return torch.zeros_like(state.features)


class WeighsNothing(Opacity):
    """The ablation of a loss."""

    name: ClassVar[str] = "weighs_nothing"

    class Config(Opacity.Config):
        """A weight of 0."""

        weight: float = 0.0


class Recurrent(FeedForward):
    """A layer of torch that lists its weights a second time."""

    name: ClassVar[str] = "recurrent"

    def __init__(self, config: ComponentConfig, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.gru = nn.GRU(dims.width, dims.width, batch_first=True)

    def forward(self, features: Tensor) -> Tensor:
        twice = features.flatten(0, 1)[:, None].expand(-1, 2, -1)
        return self.gru(twice)[0][:, -1].unflatten(0, features.shape[:2])


class MovesItsState(ContentSelfAttention):
    """`QueryState.to` goes through all fields, and sees none."""

    name: ClassVar[str] = "moves_its_state"

    def forward(self, state: QueryState) -> Tensor:
        return super().forward(state.to(state.features.device))

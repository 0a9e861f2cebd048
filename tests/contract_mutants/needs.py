"""Components that need more than they say, where what they do say is met."""

from __future__ import annotations

from typing import ClassVar

from contract_mutants.modules import PLACE
from torch import Tensor

from qgs.components import ContentSelfAttention
from qgs.contracts import ComponentConfig, Fields
from qgs.types import QueryState


class NeedsTwoSaysOne(ContentSelfAttention):
    name: ClassVar[str] = "needs_two_says_one"

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        return PLACE

    def forward(self, state: QueryState) -> Tensor:
        return super().forward(state) + state["place.center"].sum(-1, keepdim=True) * state["size"]

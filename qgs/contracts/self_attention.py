"""Slot `decoder.self_attention`: queries exchange what they know."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from torch import Tensor

from qgs.contracts.attention import AttentionWeights
from qgs.contracts.component import ModelComponent
from qgs.types import QueryState


class SelfAttention(ModelComponent):
    """QueryState -> update (B, N, D); norm and projection inside, LayerScale and residual outside.

    Permuting the queries (with all their fields) permutes the update.
    """

    slot: ClassVar[str] = "self_attention"

    @abstractmethod
    def forward(self, state: QueryState) -> Tensor:
        """The update of the query features, before LayerScale."""

    def explain(self, state: QueryState, queries: Tensor) -> AttentionWeights | None:
        """Attention of the queries with indices `queries` (Q,); None if it cannot be told."""
        return None

"""Slot `decoder.cross_attention`: queries read the images."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from torch import Tensor

from qgs.contracts.attention import AttentionWeights
from qgs.contracts.component import ModelComponent
from qgs.types import ImageMemory, QueryState


class CrossAttention(ModelComponent):
    """(QueryState, ImageMemory) -> update (B, N, D).

    Pre-norm and output projection belong to the component; LayerScale and the residual sum belong
    to the decoder layer. Neither argument is changed. Raises KeyError for a field the state lacks,
    which the composer rules out through `requires`, and RuntimeError (torch's) for a memory of
    another width or number of heads.

    ordered_views: whether the order of the views has a meaning. Without one, permuting the views of
    the memory leaves the update as it is.
    """

    slot: ClassVar[str] = "cross_attention"
    ordered_views: ClassVar[bool] = False

    @abstractmethod
    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        """The update of the query features, before LayerScale."""

    def explain(
        self, state: QueryState, memory: ImageMemory, queries: Tensor
    ) -> AttentionWeights | None:
        """Attention of the queries with indices `queries` (Q,); None if it cannot be told."""
        return None

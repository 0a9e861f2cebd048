"""The slots of a decoder layer: cross-attention, self-attention, feed-forward, refinement."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from qgs.contracts.component import ModelComponent
from qgs.types import ImageMemory, QueryState


@dataclass(frozen=True)
class AttentionWeights:
    """Attention of chosen queries, for looking inside.

    content: (B, h, Q, T) logits of content alone. geometry: (B, 1, Q, T) what geometry adds to
    them, None where nothing is added. weights: (B, h, Q, T) the softmax of their sum.
    """

    content: Tensor
    geometry: Tensor | None
    weights: Tensor


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


class FeedForward(ModelComponent):
    """Features (B, N, D) -> update (B, N, D); norm inside, LayerScale and residual outside.

    Sees each query by itself. Raises RuntimeError (torch's) for features of another width.
    """

    slot: ClassVar[str] = "feed_forward"

    @abstractmethod
    def forward(self, features: Tensor) -> Tensor:
        """The update of the query features, before LayerScale."""


class Refinement(ModelComponent):
    """QueryState -> QueryState with refined fields; features are passed on as they are.

    Runs at the end of each decoder layer. Layers with the same component and equal options share
    one module, as the published heads do, unless the class sets `shared_by_layers` to False.
    """

    slot: ClassVar[str] = "refinement"
    shared_by_layers: ClassVar[bool] = True

    @abstractmethod
    def forward(self, state: QueryState) -> QueryState:
        """A new state; the one given stays as it was."""

"""Slots of a decoder layer: `cross_attention`, `self_attention`, `feed_forward`, `refinement`.

An attention or feed-forward component holds its norms and its output projection; the decoder layer
adds LayerScale and the residual sum.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from qgs.contracts.component import ModelComponent
from qgs.types import ImageMemory, QueryState


@dataclass(frozen=True)
class AttentionWeights:
    """Attention of Q chosen queries to T tokens, for pictures.

    content: (B, h, Q, T) logits of content alone, finite. geometry: what is added to them, (B, 1,
    Q, T) or one for each head (B, h, Q, T), -inf for tokens that a mask hides; None where nothing
    is. weights: (B, h, Q, T) softmax of the sum. Raises ValueError for other shapes.
    """

    content: Tensor
    geometry: Tensor | None
    weights: Tensor

    def __post_init__(self) -> None:
        shape = tuple(self.content.shape)
        if len(shape) != 4:
            raise ValueError(f"content must have shape (B, h, Q, T), got {shape}")
        shared = (shape[0], 1, *shape[2:])
        if self.geometry is not None and self.geometry.shape not in (shared, shape):
            given = f"got {tuple(self.geometry.shape)}"
            raise ValueError(f"geometry must have shape {shared} or {shape}, {given}")
        if self.weights.shape != shape:
            raise ValueError(f"weights must have shape {shape}, got {tuple(self.weights.shape)}")


class CrossAttention(ModelComponent):
    """(QueryState, ImageMemory) -> update (B, N, D).

    Raises KeyError for a field that the state lacks (the composer rules this out through
    `requires`), and RuntimeError (torch's) for a memory of another width or number of heads.

    ordered_views: whether the order of the views matters. Otherwise, permuting the views of the
    memory leaves the update as it is.
    """

    slot: ClassVar[str] = "cross_attention"
    ordered_views: ClassVar[bool] = False

    @abstractmethod
    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        """The update of the query features, before LayerScale."""

    def explain(
        self, state: QueryState, memory: ImageMemory, queries: Tensor
    ) -> AttentionWeights | None:
        """Attention of the queries with indices `queries` (Q,); None if it has none to show."""
        return None


class SelfAttention(ModelComponent):
    """QueryState -> update (B, N, D). Permuting queries and fields permutes the update alike."""

    slot: ClassVar[str] = "self_attention"

    @abstractmethod
    def forward(self, state: QueryState) -> Tensor:
        """The update of the query features, before LayerScale."""

    def explain(self, state: QueryState, queries: Tensor) -> AttentionWeights | None:
        """Attention of the queries with indices `queries` (Q,); None if it has none to show."""
        return None


class FeedForward(ModelComponent):
    """Features (B, N, D) -> update (B, N, D), each query by itself.

    Raises RuntimeError (torch's) for features of another width.
    """

    slot: ClassVar[str] = "feed_forward"

    @abstractmethod
    def forward(self, features: Tensor) -> Tensor:
        """The update of the query features, before LayerScale."""


class Refinement(ModelComponent):
    """QueryState -> QueryState with refined fields and the same features, after each layer.

    shared_by_layers: whether layers with equal options share one module (as in LocusGS).
    """

    slot: ClassVar[str] = "refinement"
    shared_by_layers: ClassVar[bool] = True

    @abstractmethod
    def forward(self, state: QueryState) -> QueryState:
        """The refined state."""

"""Slots of the decoder: `layer`, what stands inside one, `refinement` after each, `feedback`.

An attention or feed-forward component holds its norms and its output projection; the decoder layer
adds LayerScale and the residual sum.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from qgs.containers import TensorContainer
from qgs.contracts.component import ComponentConfig, ModelComponent, ModelDims
from qgs.types import ImageMemory, QueryState, Rendering, Views

SUBLAYER_SLOTS = ("cross_attention", "self_attention", "feed_forward")
LAYER_SLOTS = ("layer", *SUBLAYER_SLOTS, "refinement")
"""Slots of the decoder that one of its layers may fill otherwise than the others."""


@dataclass(frozen=True)
class AttentionWeights(TensorContainer):
    """Attention of Q chosen queries to T tokens, for pictures.

    content: (B, h, Q, T) logits of content alone, finite. geometry: what is added to them, (B, 1,
    Q, T) or one for each head (B, h, Q, T), -inf for tokens that a mask hides; None where nothing
    is. weights: (B, h, Q, T) softmax of the sum.
    """

    content: Tensor
    geometry: Tensor | None
    weights: Tensor


@dataclass(frozen=True)
class LayerParts:
    """Parts of which a decoder layer is built.

    sublayers: components by slot, those that the class names. layer_scale: `decoder.layer_scale`.
    """

    dims: ModelDims
    sublayers: Mapping[str, ModelComponent]
    layer_scale: float


class DecoderLayer(ModelComponent):
    """(QueryState, ImageMemory) -> both, as the next layer reads them.

    A layer may update features, write fields that it declares, and return a memory with other
    features where image tokens change from layer to layer. Of a memory it keeps what it does not
    change, and the fields of a state.

    sublayers: the slots inside this layer, of `cross_attention`, `self_attention` and
        `feed_forward`; a recipe that fills another one is refused.
    reads_layer_scale: whether `decoder.layer_scale` has an effect; a recipe that sets it is refused
        where no layer reads it.
    """

    slot: ClassVar[str] = "layer"
    sublayers: ClassVar[tuple[str, ...]] = ()
    reads_layer_scale: ClassVar[bool] = True

    def __init__(self, config: ComponentConfig, parts: LayerParts) -> None:
        super().__init__(config, parts.dims)

    @abstractmethod
    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        """One layer, without the refinement."""


class CrossAttention(ModelComponent):
    """(QueryState, ImageMemory) -> update (B, N, D).

    Raises KeyError for a field that the state lacks (the composer rules this out through
    `reads`), and RuntimeError (torch's) for a memory of another width or number of heads.

    ordered_views: whether the order of the views matters. Otherwise, permuting the views of the
    memory leaves the update as it is.
    """

    slot: ClassVar[str] = "cross_attention"
    ordered_views: ClassVar[bool] = False

    @abstractmethod
    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        """The update of the query features, before LayerScale."""

    def explain(
        self,
        state: QueryState,
        memory: ImageMemory,
        queries: Tensor,  # (Q,) indices
    ) -> AttentionWeights | None:
        """Attention of some queries; None if it has none to show."""
        return None


class SelfAttention(ModelComponent):
    """QueryState -> update (B, N, D). Permuting queries and fields permutes the update."""

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
    def forward(self, features: Tensor) -> Tensor:  # (B, N, D)
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


class Feedback(ModelComponent):
    """(QueryState, ImageMemory, Rendering, Views) -> state and memory of the next round.

    A round begins with what the last layer's Gaussians look like from the cameras of the photos,
    rendered without gradients; then the last `layers` decoder layers run again, and update the
    state once more. The memory is the one that the first of them read in the first pass.

    rounds: how many an evaluation makes; it may be changed on a built model.
    """

    slot: ClassVar[str] = "feedback"
    reads_cameras: ClassVar[bool] = True
    layers: int = 0
    rounds: int = 0

    def drawn(self) -> int:
        """Number of rounds that a forward pass in training makes; it may be random."""
        return self.rounds

    def compared(self, views: Views) -> Views:
        """The input photos as they are rendered and compared; smaller ones take less time."""
        return views

    @abstractmethod
    def forward(
        self, state: QueryState, memory: ImageMemory, rendering: Rendering, photos: Views
    ) -> tuple[QueryState, ImageMemory]:
        """Input of the first repeated layer. photos: `compared` views, (B, V) as `rendering`."""

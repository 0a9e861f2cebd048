"""Contracts of the decoder's slots: `layer` and its sublayers, `refinement`, `feedback`.

An attention or feed-forward component has its own norms and output projection, and returns an
update. The decoder layer multiplies this update by LayerScale and adds it to the query features. A
refinement runs after each layer.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from qgs.containers import TensorContainer
from qgs.contracts.component import ComponentConfig, ModelComponent, ModelDims
from qgs.types import Cameras, Gaussians, ImageMemory, QueryState, Rendering, Views

Decode = Callable[[QueryState], Gaussians]
"""Function of a model that decodes a query state into Gaussians."""
Render = Callable[[Gaussians, Cameras], Rendering]
"""Function of a model that renders Gaussians (B, G) from cameras (B, V)."""
SUBLAYER_SLOTS = ("cross_attention", "self_attention", "feed_forward")
LAYER_SLOTS = ("layer", *SUBLAYER_SLOTS, "refinement")
"""Slots of the decoder for which each layer may have another component."""


@dataclass(frozen=True)
class AttentionWeights(TensorContainer):
    """Attention of Q chosen queries to T tokens, for visualisation; B scenes, h heads.

    content: (B, h, Q, T) finite logits from query and token features alone.
    geometry: the bias added to `content`, (B, 1, Q, T) for all heads or (B, h, Q, T) for each head;
        -inf for masked tokens. None without a bias.
    weights: (B, h, Q, T) softmax of `content` + `geometry` over the tokens.
    """

    content: Tensor
    geometry: Tensor | None
    weights: Tensor


@dataclass(frozen=True)
class LayerParts:
    """Parts from which a decoder layer is built.

    dims: sizes that all parts of the model share, such as the width.
    sublayers: the component for each slot that the layer's class lists in `sublayers`.
    layer_scale: value of the option `decoder.layer_scale`.
    """

    dims: ModelDims
    sublayers: Mapping[str, ModelComponent]
    layer_scale: float


class DecoderLayer(ModelComponent):
    """Decoder layer: (QueryState, ImageMemory) -> the state and memory for the next layer.

    A layer may update the features of the state and write fields that it declares in `writes`. It
    may also return a memory with new features, if image tokens change from layer to layer. It
    returns all other fields and parts unchanged.

    sublayers: the slots inside this layer, some of `cross_attention`, `self_attention` and
        `feed_forward`. A recipe that fills a sublayer slot not listed here is refused.
    reads_layer_scale: True if the layer uses the option `decoder.layer_scale`. A recipe that sets
        this option is refused if no layer uses it.
    """

    slot = "layer"
    sublayers: ClassVar[tuple[str, ...]] = ()
    reads_layer_scale: ClassVar[bool] = True

    def __init__(self, config: ComponentConfig, parts: LayerParts) -> None:
        super().__init__(config, parts.dims)

    @abstractmethod
    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        """Return the state and memory after this layer, before the refinement that follows."""


class CrossAttention(ModelComponent):
    """Cross-attention: (QueryState, ImageMemory) -> update (B, N, D): scenes, queries, width.

    Raises KeyError if the state lacks a field; model construction prevents this by checking
    `reads`. Raises torch's RuntimeError if the memory has another width or number of heads than the
    model.

    ordered_views: True if the order of the views matters. If False, permuting the views of the
        memory must not change the update.
    """

    slot = "cross_attention"
    ordered_views: ClassVar[bool] = False

    @abstractmethod
    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        """Return the update of the query features, before LayerScale."""

    def explain(
        self,
        state: QueryState,
        memory: ImageMemory,
        queries: Tensor,  # (Q,) indices
    ) -> AttentionWeights | None:
        """Return the attention weights of chosen queries; None if the component has none.

        queries: indices (Q,) of queries.
        """
        return None


class SelfAttention(ModelComponent):
    """Self-attention: QueryState -> update (B, N, D) of the features: scenes, queries, width.

    Permuting the queries, with their fields, permutes the update.
    """

    slot = "self_attention"

    @abstractmethod
    def forward(self, state: QueryState) -> Tensor:
        """Return the update of the query features, before LayerScale."""

    def explain(self, state: QueryState, queries: Tensor) -> AttentionWeights | None:
        """Return the attention weights of chosen queries; None if the component has none.

        queries: indices (Q,) of queries.
        """
        return None


class FeedForward(ModelComponent):
    """Feed-forward network on each query separately: features (B, N, D) -> update (B, N, D).

    B, N and D are scenes, queries and width. Raises torch's RuntimeError for features of another
    width than D.
    """

    slot = "feed_forward"

    @abstractmethod
    def forward(self, features: Tensor) -> Tensor:  # (B, N, D)
        """Return the update of the query features, before LayerScale."""


class Refinement(ModelComponent):
    """Refinement after each decoder layer: it changes fields of the QueryState, not its features.

    shared_by_layers: True if all layers with equal options use one module (as in LocusGS). If
        False, every layer has a module of its own.
    """

    slot = "refinement"
    shared_by_layers: ClassVar[bool] = True

    @abstractmethod
    def forward(self, state: QueryState) -> QueryState:
        """Return `state` with refined fields."""


class Feedback(ModelComponent):
    """Feedback: state, memory, views, and the model's renderings -> state and memory of a round.

    A round compares renderings of the state's Gaussians with the input photos. Then it runs
    the last `layers` decoder layers again, which update the state once more. In each round,
    `forward` gets the image memory that the first of these layers read before any feedback.

    layers: number of decoder layers that run again in each round.
    rounds: number of rounds in an evaluation; it may be changed on a built model.
    """

    slot = "feedback"
    reads_cameras: ClassVar[bool] = True
    layers: int = 0
    rounds: int = 0

    def drawn(self) -> int:
        """Return the number of feedback rounds for one pass in training; it may be random."""
        return self.rounds

    @abstractmethod
    def forward(
        self, state: QueryState, memory: ImageMemory, views: Views, decode: Decode, render: Render
    ) -> tuple[QueryState, ImageMemory]:
        """Return the query state and image memory that the first repeated layer reads.

        state: the query state after the last layer. memory: the image memory that the first
            repeated layer read in the first pass. views: the input photos (B, V). decode, render:
            the methods of the model. What is compared with photos must have no gradients.
        """

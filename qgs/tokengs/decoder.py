"""The default queries and decoder layer (TokenGS): attention without positions, and an MLP."""

from typing import Any

import torch
from pydantic import Field, NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from qgs.contracts import (
    SUBLAYER_SLOTS,
    AttentionWeights,
    ComponentConfig,
    CrossAttention,
    DecoderLayer,
    Feedback,
    FeedForward,
    LayerParts,
    LearnedQueries,
    ModelDims,
    Refinement,
    SelfAttention,
    memory_fields,
)
from qgs.tokengs.blocks import CrossAttentionCore, LayerScale, Mlp, NormConfig, SelfAttentionCore
from qgs.types import ImageMemory, QueryState


class LatentQueries(LearnedQueries):
    """N learned query vectors without a position, the same in all scenes."""

    name = "latent"

    class Config(ComponentConfig):
        count: PositiveInt = 4096
        """Number N of queries."""
        std: NonNegativeFloat = 0.01
        """Standard deviation of the initial features. 0 makes all queries equal."""

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        # Different from the start: equal queries would get equal gradients and stay equal.
        self.features = nn.Parameter(torch.randn(config.count, dims.width) * config.std)

    def start(self, batch_size: int) -> QueryState:
        return QueryState(features=self.features.expand(batch_size, -1, -1))


class CrossSelfMlp(DecoderLayer):
    """Decoder layer of cross-attention, self-attention and MLP, in this order (TokenGS release).

    The output of each sublayer is multiplied by a LayerScale and added to the features.
    """

    name = "cross_self_mlp"
    sublayers = SUBLAYER_SLOTS

    def __init__(self, config: ComponentConfig, parts: LayerParts) -> None:
        super().__init__(config, parts)
        width = parts.dims.width
        layer_scale = parts.layer_scale
        self.cross_attention = parts.sublayers["cross_attention"]
        self.cross_scale = LayerScale(width, layer_scale)
        self.self_attention = parts.sublayers["self_attention"]
        self.self_scale = LayerScale(width, layer_scale)
        self.feed_forward = parts.sublayers["feed_forward"]
        self.feed_forward_scale = LayerScale(width, layer_scale)

    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        # Each part reads the output of the part before: first the photos, then other queries.
        x_BND = state.features + self.cross_scale(self.cross_attention(state, memory))
        # self-attention reads fields too.
        state = state.replace(features=x_BND)
        x_BND = x_BND + self.self_scale(self.self_attention(state))
        x_BND = x_BND + self.feed_forward_scale(self.feed_forward(x_BND))
        return state.replace(features=x_BND), memory


class ContentCrossAttention(CrossAttention):
    """Cross-attention without positions: softmax(q k / sqrt(d)) v over all image tokens."""

    name = "content"
    reads = memory_fields("keys", "values")

    class Config(NormConfig):
        """Options of the LayerNorms."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        # No keys and values of its own: the encoder projects them once for all layers.
        self.core = CrossAttentionCore(dims.width, dims.heads, config.norm_eps)

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        return self.core(state.features, memory["keys"], memory["values"])

    def explain(self, state: QueryState, memory: ImageMemory, queries: Tensor) -> AttentionWeights:
        return self.core.explain(state.features, memory["keys"], queries)


class ContentSelfAttention(SelfAttention):
    """Pre-norm self-attention over the N queries of a scene."""

    name = "content"

    class Config(NormConfig):
        """Options of the LayerNorms."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.norm = nn.LayerNorm(dims.width, config.norm_eps)
        self.attention = SelfAttentionCore(dims.width, dims.heads, config.norm_eps)

    def read(self, state: QueryState) -> tuple[Tensor, Tensor | None]:
        """Return what attention reads: normalised features, and a mask as of SelfAttentionCore."""
        return self.norm(state.features), state.mask

    def forward(self, state: QueryState) -> Tensor:
        return self.attention(*self.read(state))

    def explain(self, state: QueryState, queries: Tensor) -> AttentionWeights:
        features, mask = self.read(state)
        return self.attention.explain(features, queries, mask)


class MlpFeedForward(FeedForward):
    """MLP with pre-norm: LayerNorm, then linear layers D -> ratio*D -> D with GELU between."""

    name = "mlp"

    class Config(NormConfig):
        ratio: float = Field(default=4.0, ge=1)
        """Hidden width of the MLP as a multiple of the model's width, rounded down."""

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        # pre-norm: the stream stays as it is.
        self.norm = nn.LayerNorm(dims.width, config.norm_eps)
        self.mlp = Mlp(dims.width, int(config.ratio * dims.width), dims.width)

    def forward(self, features: Tensor) -> Tensor:  # (B, N, D)
        return self.mlp(self.norm(features))


class NoRefinement(Refinement):
    """No refinement: the state stays unchanged."""

    name = "none"

    def forward(self, state: QueryState) -> QueryState:
        return state


class NoFeedback(Feedback):
    """No feedback: every layer runs once."""

    name = "none"
    reads_cameras = False

    def forward(
        self, state: QueryState, memory: ImageMemory, *compared: Any
    ) -> tuple[QueryState, ImageMemory]:
        return state, memory

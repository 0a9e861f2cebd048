"""`globalsplat/slots`, `globalsplat/round`: tokens with two streams, geometry and texture.

In each round, both streams attend to the features of the photos, and are then mixed.
"""

from collections.abc import Iterable

import torch
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor, nn

from qgs.contracts import (
    ComponentConfig,
    DecoderLayer,
    Fields,
    FieldSpec,
    LayerParts,
    LearnedQueries,
    ModelDims,
    Problem,
    RecipeContext,
)
from qgs.precision import at_least_float32
from qgs.tokengs import NORM_EPS, CrossAttentionCore, LayerScale, Mlp
from qgs.tokengs.encoder import EncoderBlock, keys_and_values
from qgs.types import ImageMemory, QueryState

TEXTURE = "globalsplat.texture"
"""State field (B, N, D) of the tokens' texture stream. The geometry stream is their features."""

TEXTURE_FIELD: Fields = {TEXTURE: FieldSpec(("D",))}


class SlotQueries(LearnedQueries):
    """N learned tokens, of which the last `extra` tokens are masked and decode no Gaussians.

    The initial geometry of a token is computed from it by a LayerNorm and a linear layer, and its
    initial texture by another LayerNorm and another linear layer.
    """

    name = "slots"
    writes = TEXTURE_FIELD

    class Config(ComponentConfig):
        """Options, with GlobalSplat's defaults."""

        count: PositiveInt = 2057
        """N, the number of all tokens, including `extra`."""
        extra: NonNegativeInt = 9
        """Number of tokens that decode no Gaussians (GlobalSplat: 4 auxiliary tokens, 1 token for
        scale, 4 registers)."""
        std: PositiveFloat = 0.02
        """Standard deviation of the initial tokens, which are normally distributed."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        width = dims.width
        self.slots = nn.Parameter(torch.randn(config.count - config.extra, width) * config.std)
        extra = torch.randn(config.extra, width) * config.std
        self.extra = nn.Parameter(extra) if config.extra else None
        self.geometry, self.texture = (
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width)) for _ in range(2)
        )

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Report a problem if `extra` is so large that no token is left for Gaussians."""
        if config.extra >= config.count:
            reason = f"all {config.count} tokens are extra ones, which decode no Gaussians"
            yield Problem("extra", reason, f"write at most {config.count - 1}, or raise `count`")

    def start(self, batch_size: int) -> QueryState:
        """Return the initial geometry and texture of all tokens, the same for every scene."""
        tokens_ND = self.slots if self.extra is None else torch.cat([self.slots, self.extra])
        # A state field must stay float32 under autocast; features need not.
        streams = (self.geometry(tokens_ND), at_least_float32(self.texture(tokens_ND)))
        geometry_BND, texture_BND = (x.expand(batch_size, -1, -1) for x in streams)
        mask_BN = None
        if self.extra is not None:
            places = torch.arange(self.config.count, device=self.slots.device)
            mask_BN = (places < len(self.slots)).expand(batch_size, -1)
        return QueryState(geometry_BND, {TEXTURE: texture_BND}, mask_BN)


class Round(DecoderLayer):
    """Decoder layer: cross-attention, MLP and ViT blocks in each stream, then a mixer of both.

    The streams are geometry and texture of the tokens. The mixer is an MLP that reads and updates
    both streams. `decoder.layer_scale` applies to cross-attention, MLP and mixer (GlobalSplat:
    1e-3). Masked tokens decode no Gaussians, but all tokens attend to them, so they serve as
    registers.
    """

    name = "round"
    writes = TEXTURE_FIELD

    class Config(ComponentConfig):
        """Options, with GlobalSplat's defaults."""

        memory_width: PositiveInt | None = None
        """Width of the encoder's features. With `globalsplat/patches` it is rgb_width + ray_width.
        Null means the model's width."""
        blocks: NonNegativeInt = 2
        """Number of ViT blocks in each of the two streams."""
        block_layer_scale: PositiveFloat = 0.01
        """Initial value of every LayerScale factor in the ViT blocks."""
        mlp_ratio: float = Field(default=4.0, ge=1)
        """Hidden width of the streams' MLPs, as a multiple of the model's width (rounded down)."""

    def __init__(self, config: Config, parts: LayerParts) -> None:
        super().__init__(config, parts)
        dims = parts.dims
        layer_scale = parts.layer_scale
        # Two sets of weights: shape and colour need different information from the photos.
        self.geometry = Stream(config, dims, layer_scale)
        self.texture = Stream(config, dims, layer_scale)
        self.geometry_norm = nn.LayerNorm(dims.width)
        self.texture_norm = nn.LayerNorm(dims.width)
        self.mixer = Mlp(2 * dims.width, dims.width, 2 * dims.width)
        self.mixer_scale = LayerScale(2 * dims.width, layer_scale)

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        """Return the fields that the layer reads: the encoder's features, the tokens' texture."""
        return {"memory.features": FieldSpec((config.memory_width or "D",)), **TEXTURE_FIELD}

    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        """Return tokens with updated geometry and texture, and the encoder's memory unchanged."""
        geometry_BND = self.geometry(state.features, memory.features)
        texture_BND = self.texture(state[TEXTURE], memory.features)
        # Only in the mixer do the streams see each other.
        both = [self.geometry_norm(geometry_BND), self.texture_norm(texture_BND)]
        update = self.mixer_scale(self.mixer(torch.cat(both, -1)))
        to_geometry_BND, to_texture_BND = update.chunk(2, -1)
        fields = {TEXTURE: texture_BND + to_texture_BND}
        return state.replace(features=geometry_BND + to_geometry_BND, fields=fields), memory


class Stream(nn.Module):
    """Layers of `Round` for one stream: cross-attention to the memory, MLP and ViT blocks.

    The layers have pre-norms. Each update is multiplied by a LayerScale and added.
    """

    # This bias adds the same number to all logits of a query.
    unlearned = ("k_norm.bias",)

    def __init__(self, config: Round.Config, dims: ModelDims, layer_scale: float) -> None:
        super().__init__()
        width = dims.width
        memory_width = config.memory_width or dims.width
        self.memory_norm = nn.LayerNorm(memory_width)
        self.kv_proj = nn.Linear(memory_width, 2 * width)
        self.k_norm = nn.LayerNorm(width // dims.heads)
        self.cross_attention = CrossAttentionCore(width, dims.heads)
        self.cross_scale = LayerScale(width, layer_scale)
        self.norm = nn.LayerNorm(width)
        self.mlp = Mlp(width, int(config.mlp_ratio * width), width)
        self.mlp_scale = LayerScale(width, layer_scale)
        scale = config.block_layer_scale
        self.blocks = nn.ModuleList(
            EncoderBlock(width, dims.heads, config.mlp_ratio, scale, NORM_EPS)
            for _ in range(config.blocks)
        )

    def forward(self, x_BND: Tensor, memory_BMC: Tensor) -> Tensor:
        """Return the stream (B, N, D), updated by all layers. memory_BMC: encoder's features."""
        keys, values = keys_and_values(self.memory_norm(memory_BMC), self.kv_proj, self.k_norm)
        x_BND = x_BND + self.cross_scale(self.cross_attention(x_BND, keys, values))
        x_BND = x_BND + self.mlp_scale(self.mlp(self.norm(x_BND)))
        for block in self.blocks:
            x_BND = block(x_BND)
        return x_BND

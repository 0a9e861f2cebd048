"""`c3g/joint`: a decoder layer in which image tokens and queries attend to each other.

`c3g/head`: head that turns each query into one Gaussian or several. Axes: T = M + N tokens, first
the M image tokens, then the N queries.
"""

import torch
import torch.nn.functional as F
from pydantic import Field, PositiveFloat, PositiveInt
from torch import Tensor, nn

from qgs.contracts import DecoderLayer, LayerParts, ModelDims, memory_fields
from qgs.geometry.harmonics import SH_C0
from qgs.precision import at_least_float32
from qgs.tokengs import LinearHead, Mlp, NormConfig
from qgs.types import GaussianAttributes, ImageMemory, QueryState
from qgs_zoo.parts import Decaying, self_attention


class JointLayer(Decaying, DecoderLayer):
    """Decoder layer with self-attention over image tokens and queries together, then an MLP (C3G).

    It computes x + Attention(LayerNorm(x)), then x + MLP(LayerNorm(x)), without LayerScale. It
    updates the features of image tokens and queries, but not the keys, values and rays in the
    encoder's memory.
    """

    name = "joint"
    reads = memory_fields("features")
    reads_layer_scale = False

    class Config(NormConfig):
        mlp_ratio: float = Field(default=2.0, ge=1)
        """Hidden width of the MLP, as a multiple of the model's width (rounded down)."""

    config: Config

    def __init__(self, config: Config, parts: LayerParts) -> None:
        super().__init__(config, parts)
        width = parts.dims.width
        self.norm = nn.LayerNorm(width, config.norm_eps)
        self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.proj = nn.Linear(width, width)
        self.mlp_norm = nn.LayerNorm(width, config.norm_eps)
        self.mlp = Mlp(width, int(config.mlp_ratio * width), width)

    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        """Return updated queries and image tokens. No token attends to masked queries."""
        # Image tokens come first, so that one cut separates them from queries.
        tokens = memory.features.shape[1]
        x_BTD = torch.cat([memory.features, state.features], 1)
        # Without a mask torch uses its fastest kernel.
        mask_B11T = None
        if state.mask is not None:
            mask_B11T = F.pad(state.mask, (tokens, 0), value=True)[:, None, None]
        # Masked queries still read other tokens, but no token reads them.
        qkv_BTX = self.qkv(self.norm(x_BTD))
        x_BTD = x_BTD + self.proj(self_attention(qkv_BTX, self.dims.heads, mask_B11T))
        x_BTD = x_BTD + self.mlp(self.mlp_norm(x_BTD))
        tokens_BMD, queries_BND = x_BTD.tensor_split([tokens], 1)
        return state.replace(features=queries_BND), memory.replace(features=tokens_BMD)


CHANNELS = (3, 1, 3, 4, 3)
"""Channels per Gaussian: position, opacity, scale, rotation, colour (C3G release)."""


class C3GHead(Decaying, LinearHead):
    """Head with LayerNorm, a linear layer, and the activations of the C3G release.

    The linear layer maps the D features of a query to K Gaussians of 14 raw channels.
    """

    name = "head"

    class Config(NormConfig):
        gaussians_per_query: PositiveInt = 1
        """K, the number of Gaussians decoded from each query."""
        scale_unit: PositiveFloat = 0.001
        """Unit of scales of Gaussians: a scale in world units is `scale_unit` times softplus(raw
        scale)."""
        quat_eps: PositiveFloat = 1e-8
        """Lower bound of the length by which a raw quaternion is divided when it is normalised."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.norm = nn.LayerNorm(dims.width, config.norm_eps)
        self.linear = nn.Linear(dims.width, config.gaussians_per_query * sum(CHANNELS))

    def activate(self, raw_BNKC: Tensor) -> GaussianAttributes:
        offsets, opacity, scale, rotation, sh = at_least_float32(raw_BNKC).split(CHANNELS, -1)
        return GaussianAttributes(
            offsets=offsets,
            scales=self.config.scale_unit * F.softplus(scale),
            quats=F.normalize(rotation, dim=-1, eps=self.config.quat_eps),
            opacities=torch.sigmoid(opacity[..., 0]),
            # The release renders a harmonic of degree 0 and clips the colour.
            colors=(0.5 + SH_C0 * sh).clamp(0, 1),
        )

"""`c3g/joint`: a decoder layer in which image tokens and queries attend to each other.

Axes: T = M + N tokens, those of the images first.
"""

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

from qgs.contracts import ComponentConfig, DecoderLayer, LayerParts, memory_fields
from qgs.tokengs import NORM_EPS, Mlp
from qgs.types import ImageMemory, QueryState
from qgs_zoo.parts import self_attention


class JointLayer(DecoderLayer):
    """Self-attention over [image tokens; queries], then an MLP; both change (C3G).

    x + Attention(LayerNorm(x)), then x + MLP(LayerNorm(x)). There is no LayerScale.
    Keys, values and rays of the memory stay.
    """

    name = "joint"
    reads = memory_fields("features")
    reads_layer_scale = False

    class Config(ComponentConfig):
        mlp_ratio: float = Field(default=2.0, ge=1)
        """Hidden width of the MLP (rounded down) over the model's width."""
        norm_eps: float = Field(default=NORM_EPS, gt=0)
        """Added to the variance by every LayerNorm."""

    config: Config

    def __init__(self, config: Config, parts: LayerParts) -> None:
        super().__init__(config, parts)
        width = parts.dims.width
        self.norm = nn.LayerNorm(width, config.norm_eps)
        self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.proj = nn.Linear(width, width)
        self.mlp_norm = nn.LayerNorm(width, config.norm_eps)
        self.mlp = Mlp(width, int(config.mlp_ratio * width), width)

    def decays(self, name: str, parameter: nn.Parameter) -> bool:
        """Weight decay on all (C3G release)."""
        return True

    def forward(self, state: QueryState, memory: ImageMemory) -> tuple[QueryState, ImageMemory]:
        """Queries and image tokens that have read each other; nobody reads a masked query."""
        # Image tokens stand first, so that slices tell them from queries.
        tokens = memory.features.shape[1]
        x_BTD = torch.cat([memory.features, state.features], 1)
        x_BTD = x_BTD + self.attention(self.norm(x_BTD), state.mask)
        x_BTD = x_BTD + self.mlp(self.mlp_norm(x_BTD))
        queries_BND = x_BTD[:, tokens:]
        tokens_BMD = x_BTD[:, :tokens]
        return state.replace(features=queries_BND), memory.replace(features=tokens_BMD)

    def attention(self, x_BTD: Tensor, mask_BN: Tensor | None) -> Tensor:
        """softmax(q k / sqrt(d)) v over all tokens but masked queries, (B, T, D)."""
        # Without a mask torch takes its fastest kernel.
        mask_B11T = None
        if mask_BN is not None:
            images = x_BTD.shape[1] - mask_BN.shape[1]
            mask_B11T = F.pad(mask_BN, (images, 0), value=True)[:, None, None]
        # Queries that the mask leaves out still read: only nobody reads them.
        return self.proj(self_attention(self.qkv(x_BTD), self.dims.heads, mask_B11T))

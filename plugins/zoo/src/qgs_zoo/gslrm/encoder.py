"""`gslrm/transformer`: patches of colours and rays, one linear layer, a plain transformer."""

import torch
import torch.nn.functional as F
from einops import rearrange
from pydantic import Field
from torch import Tensor, nn

from qgs.contracts import ModelDims, PatchEncoder, memory_fields
from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.tokengs import NORM_EPS
from qgs.types import ImageMemory, Views
from qgs_zoo.parts import self_attention

CHANNELS = 9
"""Per pixel: 2 RGB - 1, moment o x d and unit direction d of its ray (paper, section 3.1)."""


class Block(nn.Module):
    """Pre-norm self-attention and MLP (exact GELU), no biases: (B, M, D) -> (B, M, D)."""

    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.heads = heads
        hidden = int(mlp_ratio * width)
        self.norm1 = nn.LayerNorm(width, NORM_EPS, bias=False)
        self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.proj = nn.Linear(width, width, bias=False)
        self.norm2 = nn.LayerNorm(width, NORM_EPS, bias=False)
        self.fc1 = nn.Linear(width, hidden, bias=False)
        self.fc2 = nn.Linear(hidden, width, bias=False)

    def forward(self, x_BMD: Tensor) -> Tensor:
        x_BMD = x_BMD + self.proj(self_attention(self.qkv(self.norm1(x_BMD)), self.heads))
        return x_BMD + self.fc2(F.gelu(self.fc1(self.norm2(x_BMD))))


class Transformer(PatchEncoder):
    """A token for each patch of all views, through blocks of self-attention over all of them.

    Its memory has features, rays and the grid, but neither keys nor values: GS-LRM has no decoder.
    """

    name = "transformer"
    writes = memory_fields("features", "patch_rays", "grid")

    class Config(PatchEncoder.Config):
        depth: int = Field(default=24, ge=0, le=256)
        """Number of blocks."""
        mlp_ratio: float = Field(default=4.0, ge=1)
        """Hidden width of the MLPs (rounded down) over the model's width."""
        init_std: float = Field(default=0.02, gt=0)
        """Standard deviation of the normal distribution that all weights of linear layers start
        from."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.embedding = nn.Linear(CHANNELS * config.patch_size**2, dims.width, bias=False)
        self.norm = nn.LayerNorm(dims.width, NORM_EPS, bias=False)
        self.blocks = nn.ModuleList(
            Block(dims.width, dims.heads, config.mlp_ratio) for _ in range(config.depth)
        )
        # The paper starts all linear layers alike, without a scale for the depth.
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, std=config.init_std)

    def forward(self, views: Views) -> ImageMemory:
        """Features (B, M, D), before any last norm, which belongs to the head.

        Raises ValueError when the patch does not divide the images.
        """
        patch = self.config.patch_size
        grid = self.grid(views)
        plucker_BV6HW = plucker_rays(views.cameras)
        pixels_BV9HW = torch.cat([2 * views.images - 1, plucker_BV6HW], 2)
        x_BMC = rearrange(pixels_BV9HW, "b v c (h p) (w q) -> b (v h w) (p q c)", p=patch, q=patch)
        # Rays stand beside the colours of each pixel, so that positions need no embedding.
        x_BMD = self.norm(self.embedding(x_BMC))
        for block in self.blocks:
            x_BMD = block(x_BMD)
        return ImageMemory(features=x_BMD, patch_rays=patch_rays(plucker_BV6HW, patch), grid=grid)

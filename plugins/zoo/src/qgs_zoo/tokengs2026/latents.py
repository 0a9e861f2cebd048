"""`tokengs2026/latent_bottleneck`: learned latents that stand for the photos (TokenGS 2026.6).

Axes: L latents, C = S D the width of the image tokens' features.
"""

import torch
from pydantic import Field
from torch import Tensor, nn

from qgs.contracts import ModelDims, memory_fields
from qgs.geometry.rays import plucker_rays
from qgs.tokengs.blocks import CrossAttentionCore, LayerScale, Mlp, SelfAttentionCore
from qgs.tokengs.encoder import keys_and_values
from qgs.types import ImageMemory, Views
from qgs_zoo.tokengs2026.multiscale import MultiscaleReadout


class LatentBlock(nn.Module):
    """Cross-attention to given keys and values, self-attention, MLP; each scaled and added."""

    def __init__(
        self, width: int, heads: int, mlp_ratio: float, layer_scale: float, norm_eps: float
    ) -> None:
        super().__init__()
        self.cross_attention = CrossAttentionCore(width, heads, norm_eps)
        self.cross_scale = LayerScale(width, layer_scale)
        self.self_norm = nn.LayerNorm(width, norm_eps)
        self.self_attention = SelfAttentionCore(width, heads, norm_eps)
        self.self_scale = LayerScale(width, layer_scale)
        self.mlp_norm = nn.LayerNorm(width, norm_eps)
        self.mlp = Mlp(width, int(mlp_ratio * width), width)
        self.mlp_scale = LayerScale(width, layer_scale)

    def forward(self, x_BLD: Tensor, k_BhMd: Tensor, v_BhMd: Tensor) -> Tensor:
        x_BLD = x_BLD + self.cross_scale(self.cross_attention(x_BLD, k_BhMd, v_BhMd))
        x_BLD = x_BLD + self.self_scale(self.self_attention(self.self_norm(x_BLD)))
        return x_BLD + self.mlp_scale(self.mlp(self.mlp_norm(x_BLD)))


class LatentBottleneck(MultiscaleReadout):
    """L learned latents read several blocks of a ViT; the memory is made of them alone.

    It has neither rays nor a grid, and as many tokens for two photos as for six.
    """

    name = "latent_bottleneck"
    tunable = True
    writes = memory_fields("features", "keys", "values")
    # Adds the same to all logits of a latent.
    unlearned = ("feature_k_norm.bias",)

    class Config(MultiscaleReadout.Config):
        depth: int = Field(default=12, ge=1, le=256)
        """Number of ViT blocks."""
        blocks: tuple[int, ...] = Field(default=(6, 8, 10, 12), min_length=1)
        """Numbers of the blocks that are read, ascending; 1 is the first, and `depth` the last."""
        latents: int = Field(ge=1)
        """L, the number of latents (TokenGS: 4096)."""
        latent_std: float = Field(default=0.02, ge=0)
        """Standard deviation of the normal distribution that the latents start from."""
        latent_depth: int = Field(default=12, ge=1, le=256)
        """Number of blocks over the latents; their MLPs and LayerScale are as of the ViT's."""

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        width = dims.width
        eps = config.norm_eps
        self.latents = nn.Parameter(torch.randn(config.latents, width) * config.latent_std)
        self.feature_kv_proj = nn.Linear(self.feature_width, 2 * width)
        self.feature_k_norm = nn.LayerNorm(width // dims.heads, eps)
        self.latent_blocks = nn.ModuleList(
            LatentBlock(width, dims.heads, config.mlp_ratio, config.layer_scale, eps)
            for _ in range(config.latent_depth)
        )
        self.latent_kv_proj = nn.Linear(width, 2 * width)
        self.k_norm = nn.LayerNorm(width // dims.heads, eps)

    def decays(self, name: str, parameter: nn.Parameter) -> bool:
        """No weight decay on the latents (TokenGS release)."""
        return name != "latents" and super().decays(name, parameter)

    def forward(self, views: Views) -> ImageMemory:
        """The latents (B, L, D) that have read all views, and their keys and values.

        Raises ValueError when the patch does not divide the images.
        """
        # It refuses images that the patch does not divide.
        self.grid(views)
        x_BMC = self.features(views, plucker_rays(views.cameras))
        k_BhMd, v_BhMd = keys_and_values(x_BMC, self.feature_kv_proj, self.feature_k_norm)
        x_BLD = self.latents.expand(len(x_BMC), -1, -1)
        for block in self.latent_blocks:
            x_BLD = block(x_BLD, k_BhMd, v_BhMd)
        return self._memory(x_BLD)

    def project(self, features: Tensor, memory: ImageMemory) -> ImageMemory:
        """The memory of other latents (B, L, D)."""
        # Tuning at test time changes the latents and makes keys of them anew.
        return self._memory(features)

    def _memory(self, latents: Tensor) -> ImageMemory:
        keys, values = keys_and_values(latents, self.latent_kv_proj, self.k_norm)
        return ImageMemory(latents, keys, values)

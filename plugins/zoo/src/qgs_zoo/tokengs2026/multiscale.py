"""Encoders that read the outputs of several ViT blocks (TokenGS 2026.6).

`tokengs2026/multiscale_vit` computes keys and values from the outputs of the blocks.
`tokengs2026/latent_bottleneck` computes keys and values from learned latents that attend to the
outputs.

Axes: T channels that encode a time, L latents, S blocks, C = S D the width of the blocks'
concatenated outputs.
"""

import math
from collections.abc import Iterable, Iterator

import torch
import torch.nn.functional as F
from pydantic import Field, NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from qgs.contracts import (
    MEMORY_FIELDS,
    Fields,
    FieldSpec,
    ModelDims,
    Problem,
    RecipeContext,
    memory_fields,
)
from qgs.contracts.settings import Rising
from qgs.geometry.rays import plucker_rays
from qgs.precision import full_precision
from qgs.tokengs.blocks import CrossAttentionCore, LayerScale, Mlp, SelfAttentionCore
from qgs.tokengs.encoder import PatchViT, keys_and_values
from qgs.types import ImageMemory, Views


@full_precision
def time_features(times: Tensor, channels: int) -> Tensor:
    """Encode times t (...) as (..., T): the cosines of T/2 angles, then their sines.

    The angles are t exp(-ln(10000) i / (T/2)) for i from 0 to T/2 - 1. T is `channels`.
    """
    half = channels // 2
    rates = torch.exp(-math.log(10_000) / half * torch.arange(half, device=times.device).to(times))
    angles = times[..., None] * rates
    return torch.cat([angles.cos(), angles.sin()], -1)


def without_times(channels: int, context: RecipeContext) -> Iterator[Problem]:
    """Report a problem if `time_channels` is above 0, but the recipe's data have no times."""
    if channels and context.inputs is not None and not context.times:
        yield Problem(
            "time_channels",
            f"the data of this recipe have no times: `time_channels: {channels}` reads them",
            "set time_channels to 0, or use qgs/photos with a 'time' for each frame of the "
            "transforms file, or datasets/chunks packed from such photos",
        )


class TimeEmbedding(nn.Module):
    """Embedding of times (B, V) as (B, V, D). It is zero before training.

    The embedding is a convolution of a patch of equal pixels, because the release embeds a map of
    times.
    """

    def __init__(self, channels: int, width: int, patch_size: int) -> None:
        """Make the embedding for T = `channels` channels per time, an even number."""
        super().__init__()
        self.proj = nn.Conv2d(channels, width, kernel_size=patch_size, stride=patch_size)
        for parameter in self.proj.parameters():
            nn.init.zeros_(parameter)

    def forward(self, times: Tensor) -> Tensor:
        numbers = time_features(times, self.proj.in_channels)
        # All pixels of a patch are equal.
        return F.linear(numbers, self.proj.weight.sum((2, 3)), self.proj.bias)


class MultiscaleReadout(PatchViT):
    """Base of encoders whose features are the outputs of S chosen ViT blocks.

    Each block's output has its own norm. Unlike the default encoder, these encoders can embed the
    times of photos.
    """

    class Config(PatchViT.Config):
        blocks: Rising = (1, 2, 3)
        """Numbers of the ViT blocks whose outputs are read, in ascending order. The first block is
        1. The largest number must be `depth`."""
        time_channels: int = Field(default=0, ge=0, multiple_of=2)
        """Number of channels that encode the time of a photo. 0 ignores the times of photos."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.norms = nn.ModuleList(nn.LayerNorm(dims.width, config.norm_eps) for _ in config.blocks)
        self.feature_width = len(config.blocks) * dims.width
        if config.time_channels:
            self.time_embedding = TimeEmbedding(config.time_channels, dims.width, config.patch_size)

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        yield from super().problems(config, context)
        yield from without_times(config.time_channels, context)
        last = config.blocks[-1]
        # Blocks after the last one that is read would learn nothing.
        if last != config.depth:
            what = "does not exist" if last > config.depth else "leaves the blocks after it unread"
            yield Problem(
                "blocks",
                f"the last block that is read, number {last} of {config.depth}, {what}",
                f"set depth to {last}, or let blocks end with {config.depth}",
            )

    def embed(self, views: Views, plucker: Tensor) -> Tensor:
        """Return the sum (B, M, D) of the embeddings of colours, rays and times.

        plucker: Plücker rays of all pixels, (B, V, 6, H, W). `time_channels: 0` leaves out the
        times. Raises ValueError for other values if the views have no times.
        """
        x_BMD = super().embed(views, plucker)
        if not self.config.time_channels:
            return x_BMD
        if views.times is None:
            raise ValueError(
                "this encoder reads the times of photos, but they have none: give each frame "
                "of the transforms file a 'time' and pack chunks again, give the views times "
                "(B, V), or set model.encoder.time_channels to 0"
            )
        times_BVD = self.time_embedding(views.times)
        return x_BMD + times_BVD.repeat_interleave(x_BMD.shape[1] // times_BVD.shape[1], 1)

    def features(self, views: Views, plucker: Tensor) -> Tensor:
        """Return the concatenated outputs (B, M, S D) of the chosen blocks, in block order.

        plucker: Plücker rays of all pixels.
        """
        x_BMD = self.embed(views, plucker)
        outputs = []
        for number, block in enumerate(self.blocks, start=1):
            x_BMD = block(x_BMD)
            if number in self.config.blocks:
                # Each block has its own norm, because the sizes of outputs differ.
                outputs.append(self.norms[len(outputs)](x_BMD))
        return torch.cat(outputs, -1)


class MultiscaleViT(MultiscaleReadout):
    """Encoder that computes keys and values of image tokens from outputs of several ViT blocks."""

    name = "multiscale_vit"

    def __init__(self, config: MultiscaleReadout.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.kv_proj = nn.Linear(self.feature_width, 2 * dims.width)
        self.k_norm = nn.LayerNorm(dims.width // dims.heads, config.norm_eps)

    @classmethod
    def fields_written(cls, config: MultiscaleReadout.Config) -> Fields:
        scales = len(config.blocks)
        wide = FieldSpec(("D" if scales == 1 else f"{scales}*D",))
        return {**MEMORY_FIELDS, "memory.features": wide}


class LatentBlock(nn.Module):
    """Transformer block: cross-attention to given keys and values, then self-attention, then MLP.

    The output of each of these layers is multiplied by a LayerScale and added.
    """

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
    """Encoder whose tokens are L learned latents that attend to the outputs of several ViT blocks.

    The memory has the same size for any number of photos. It contains no rays and no grid.
    """

    name = "latent_bottleneck"
    tunable = True
    writes = memory_fields("features", "keys", "values")
    # This bias adds the same number to all logits of a latent.
    unlearned = ("feature_k_norm.bias",)

    class Config(MultiscaleReadout.Config):
        depth: PositiveInt = 12
        """Number of ViT blocks."""
        blocks: Rising = (6, 8, 10, 12)
        """Numbers of the ViT blocks whose outputs are read, in ascending order. The first block is
        1. The largest number must be `depth`."""
        latents: PositiveInt
        """L, the number of learned latents (TokenGS: 4096)."""
        latent_std: NonNegativeFloat = 0.02
        """Standard deviation of the initial latents, which are normally distributed."""
        latent_depth: PositiveInt = 12
        """Number of transformer blocks that update the latents. Sizes of their MLPs and initial
        LayerScales are those of the ViT."""

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
        """Return whether a parameter has weight decay. The latents have none (TokenGS release)."""
        return name != "latents" and super().decays(name, parameter)

    def forward(self, views: Views) -> ImageMemory:
        """Return the latents (B, L, D) after attention to all views, and their keys and values.

        Raises ValueError if the patch size does not divide the sides of the images.
        """
        # Called only for this error.
        self.grid(views)
        x_BMC = self.features(views, plucker_rays(views.cameras))
        k_BhMd, v_BhMd = keys_and_values(x_BMC, self.feature_kv_proj, self.feature_k_norm)
        x_BLD = self.latents.expand(len(x_BMC), -1, -1)
        for block in self.latent_blocks:
            x_BLD = block(x_BLD, k_BhMd, v_BhMd)
        return self.project(x_BLD, ImageMemory(x_BLD))

    def project(self, features: Tensor, memory: ImageMemory) -> ImageMemory:
        """Return the memory for changed latents `features` (B, L, D), with new keys and values."""
        # Tuning at test time changes the latents, and then needs new keys and values.
        keys, values = keys_and_values(features, self.latent_kv_proj, self.k_norm)
        return ImageMemory(features, keys, values)

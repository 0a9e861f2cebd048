"""`globalsplat/patches`: patches, their rays and their cameras, side by side, without a network."""

import math
from typing import Any

import torch
from einops import rearrange
from pydantic import Field
from torch import Tensor, nn

from qgs.contracts import Fields, FieldSpec, ModelDims, PatchEncoder, memory_fields
from qgs.geometry.constants import constant
from qgs.geometry.rays import plucker_rays
from qgs.precision import full_precision
from qgs.tokengs import Mlp
from qgs.types import Cameras, ImageMemory, Views

REGISTER_STD = 0.02
"""Standard deviation of the normal distribution that the registers start from."""


class PosedPatches(PatchEncoder):
    """A token of each patch: its colours beside its rays, to which its camera is added.

    The features are `rgb_width` + `ray_width` wide, whatever the width of the model. Learned
    registers, which are of no patch, stand behind the patches.
    """

    name = "patches"

    class Config(PatchEncoder.Config):
        """Defaults are GlobalSplat's; the size of a patch is ours."""

        rgb_width: int = Field(default=512, ge=1)
        """Channels of a token that are made of the patch's colours."""
        ray_width: int = Field(default=256, ge=1)
        """Channels of a token that are made of the patch's Plücker rays and of the camera."""
        lens_width: int = Field(default=64, ge=1)
        """Numbers that are made of focal lengths and principal point."""
        bands: int = Field(default=4, ge=0)
        """Frequencies of the encoding of a camera's position, which has the position itself too."""
        registers: int = Field(default=4, ge=0)
        """Learned tokens behind those of the patches."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        rgb = config.rgb_width
        ray = config.ray_width
        # Without biases, as LayerNorm follows in every stream.
        side: Any = {"kernel_size": config.patch_size, "stride": config.patch_size, "bias": False}
        self.rgb_embedding = nn.Conv2d(3, rgb, **side)
        self.ray_embedding = nn.Conv2d(6, ray, **side)
        self.lens_mlp = Mlp(4, config.lens_width, config.lens_width)
        self.camera_proj = nn.Linear(config.lens_width + 3 + 3 * 2 * config.bands, ray)
        registers = torch.randn(config.registers, rgb + ray) * REGISTER_STD
        self.registers = nn.Parameter(registers) if config.registers else None

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        """Features of their own width, and a grid where there are no registers behind it."""
        features = {"memory.features": FieldSpec((config.rgb_width + config.ray_width,))}
        return features if config.registers else {**features, **memory_fields("grid")}

    def forward(self, views: Views) -> ImageMemory:
        """The memory, with a grid where there are no registers."""
        grid = self.grid(views)
        rgb_BVPC = _tokens(self.rgb_embedding, 2 * views.images - 1)
        ray_BVPC = _tokens(self.ray_embedding, plucker_rays(views.cameras))
        # A camera is the same for all its patches: added once for each view.
        camera_BVC = torch.cat(
            [self.lens_mlp(lens(views.cameras)), place(views.cameras, self.config.bands)], -1
        )
        ray_BVPC = ray_BVPC + self.camera_proj(camera_BVC)[:, :, None]
        x_BMC = torch.cat([rgb_BVPC, ray_BVPC], -1).flatten(1, 2)
        if self.registers is None:
            return ImageMemory(features=x_BMC, grid=grid)
        registers_BRC = self.registers.to(x_BMC).expand(len(x_BMC), -1, -1)
        return ImageMemory(features=torch.cat([x_BMC, registers_BRC], 1))


def _tokens(embedding: nn.Conv2d, images: Tensor) -> Tensor:
    """(B, V, C, H, W) -> (B, V, patches, width)."""
    x_XDHW = embedding(images.flatten(0, 1))
    return rearrange(x_XDHW, "(b v) d h w -> b v (h w) d", b=len(images))


@full_precision
def lens(cameras: Cameras) -> Tensor:
    """(..., 4): log of the focal lengths, then the principal point, in sides of the image."""
    height, width = cameras.size
    sides = constant([width, height], cameras.intrinsics)
    focal, principal = (cameras.intrinsics / sides.repeat(2)).chunk(2, -1)
    # Logarithms: focal lengths of phones and telephotos differ by factors.
    return torch.cat([focal.log(), principal], -1)


@full_precision
def place(cameras: Cameras, bands: int) -> Tensor:
    """(..., 3 + 6 bands): the centre x, then sin and cos of 2^k pi x for k = 0 .. bands - 1."""
    center = cameras.c2w[..., :3, 3]
    octaves = 2 ** torch.arange(bands, dtype=center.dtype, device=center.device)
    angles = (math.pi * octaves[:, None] * center[..., None, :]).flatten(-2)
    return torch.cat([center, angles.sin(), angles.cos()], -1)

"""`globalsplat/patches`: encoder that embeds patches, rays and cameras, without attention."""

import math
from functools import partial

import torch
from einops import rearrange
from pydantic import NonNegativeInt, PositiveInt
from torch import Tensor, nn

from qgs.contracts import Fields, FieldSpec, ModelDims, PatchEncoder, memory_fields
from qgs.geometry.constants import constant
from qgs.geometry.rays import plucker_rays
from qgs.precision import full_precision
from qgs.tokengs import Mlp
from qgs.types import Cameras, ImageMemory, Views

REGISTER_STD = 0.02
"""Standard deviation of the initial registers, which are normally distributed."""


class PosedPatches(PatchEncoder):
    """Encoder with a token for each patch: embedded colours, then embedded rays and camera.

    The two embeddings are concatenated, so tokens have `rgb_width` + `ray_width` channels, whatever
    the model's width is. After the patches come registers: learned tokens that belong to no patch.
    """

    name = "patches"

    class Config(PatchEncoder.Config):
        """Options, with GlobalSplat's defaults except for `patch_size`."""

        rgb_width: PositiveInt = 512
        """Number of channels of a token that embed the patch's colours."""
        ray_width: PositiveInt = 256
        """Number of channels of a token that embed the patch's Plücker rays and the camera."""
        lens_width: PositiveInt = 64
        """Number of channels that embed focal lengths and principal point of a camera."""
        bands: NonNegativeInt = 4
        """Number of frequencies of sines and cosines that encode a camera's position, besides the
        position itself. 0 encodes only the position itself."""
        registers: NonNegativeInt = 4
        """Number of registers: learned tokens after those of the patches. 0 means none."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        rgb = config.rgb_width
        ray = config.ray_width
        # No biases, because a LayerNorm follows in every stream.
        side = config.patch_size
        embedding = partial(nn.Conv2d, kernel_size=side, stride=side, bias=False)
        self.rgb_embedding = embedding(3, rgb)
        self.ray_embedding = embedding(6, ray)
        self.lens_mlp = Mlp(4, config.lens_width, config.lens_width)
        self.camera_proj = nn.Linear(config.lens_width + 3 + 3 * 2 * config.bands, ray)
        registers = torch.randn(config.registers, rgb + ray) * REGISTER_STD
        self.registers = nn.Parameter(registers) if config.registers else None

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        """Return the fields of the image memory that the encoder writes.

        These are the features, with their width, and the grid of patches if there are no registers.
        """
        features = {"memory.features": FieldSpec((config.rgb_width + config.ray_width,))}
        return features if config.registers else {**features, **memory_fields("grid")}

    def forward(self, views: Views) -> ImageMemory:
        """Return the tokens of patches and registers. Without registers, also return the grid."""
        grid = self.grid(views)
        rgb_BVPC = _tokens(self.rgb_embedding, 2 * views.images - 1)
        ray_BVPC = _tokens(self.ray_embedding, plucker_rays(views.cameras))
        # A camera is the same for all its patches, so it is embedded once per view.
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
    """Embed images (B, V, C, H, W) as tokens (B, V, patches, width)."""
    x_XDHW = embedding(images.flatten(0, 1))
    return rearrange(x_XDHW, "(b v) d h w -> b v (h w) d", b=len(images))


@full_precision
def lens(cameras: Cameras) -> Tensor:
    """Return logarithms of focal lengths, then the principal point, of each camera: (..., 4).

    Lengths along x are in units of the image's width, lengths along y in units of its height.
    """
    height, width = cameras.size
    sides = constant([width, height], cameras.intrinsics)
    focal, principal = (cameras.intrinsics / sides.repeat(2)).chunk(2, -1)
    # Logarithms, because focal lengths of phones and telephotos differ by factors.
    return torch.cat([focal.log(), principal], -1)


@full_precision
def place(cameras: Cameras, bands: int) -> Tensor:
    """Encode the centre x of each camera as 3 + 6 `bands` numbers, in the last dimension.

    The numbers are x, then sin and cos of 2^k pi x for k = 0 .. bands - 1.
    """
    center = cameras.c2w[..., :3, 3]
    octaves = 2 ** torch.arange(bands, dtype=center.dtype, device=center.device)
    angles = (math.pi * octaves[:, None] * center[..., None, :]).flatten(-2)
    return torch.cat([center, angles.sin(), angles.cos()], -1)

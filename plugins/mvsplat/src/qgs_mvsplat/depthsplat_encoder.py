"""`mvsplat/depthsplat`: DepthSplat's networks as an encoder, a token for each pixel."""

from collections.abc import Iterable
from typing import Annotated, Literal, TypeAlias

import torch
from einops import rearrange
from pydantic import Field
from qgs_dinov2.vit import VitConfig
from qgs_dinov2.weight_file import load_weights
from torch import Tensor, nn

from qgs.contracts import (
    ComponentConfig,
    Encoder,
    Fields,
    FieldSpec,
    ModelDims,
    Problem,
    RecipeContext,
    memory_fields,
)
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.precision import at_least_float32
from qgs.types import ImageMemory, Views
from qgs_mvsplat.adapter import SH_DEGREE, coefficients
from qgs_mvsplat.cnn import WIDTHS
from qgs_mvsplat.depthsplat import GAUSSIAN_CHANNELS, DepthSplat, Sizes
from qgs_mvsplat.mvsplat import check_size, size_problems
from qgs_mvsplat.pixels import predicted

Width: TypeAlias = Annotated[int, Field(ge=1)]


class DepthSplatEncoder(Encoder):
    """Every pixel's depth and raw Gaussian, from a plane sweep and a pretrained ViT.

    The memory has a token for each pixel, with the numbers of `qgs_mvsplat.pixels.CHANNELS` and
    harmonics, to whose constant the pixel's colour is added; with `coarse_depth` also, in the last
    channel, the logarithm of the depth of the first sweep. D, the model's width, is that of the
    multi-view features (published: 128).
    """

    name = "depthsplat"
    # With more than three views, equally distant neighbours are taken in the order of the views;
    # with three, keys of shifted windows meet the mask of others (released code).
    ordered_views = True

    class Config(ComponentConfig):
        """Defaults are the small model on RealEstate10K."""

        near: float = Field(default=0.5, gt=0)
        """Least depth, world units."""
        far: float = Field(default=100.0, gt=0)
        """Largest depth, world units; 200 on DL3DV."""
        candidates: int = Field(default=128, ge=16, multiple_of=8)
        """Inverse depths of the first sweep, evenly between those of `far` and `near`; the second
        has a quarter."""
        scales: Literal[1, 2] = 1
        """Sweeps: the second has twice the resolution, around the depths of the first."""
        stride: Literal[4, 8] = 4
        """Pixels a side of a feature of the first sweep."""
        neighbours: int = Field(default=2, ge=1)
        """Views that each view is matched with where there are more than three, the nearest."""
        vit: VitConfig = VitConfig()
        """DINOv2's sizes and weights."""
        blocks: tuple[int, int, int, int] = (2, 5, 8, 11)
        """Blocks of the ViT whose tokens are read, 0 for the first; ViT-L: 4, 11, 17, 23."""
        cnn: tuple[Width, Width, Width] = WIDTHS
        """Channels of the three stages of the CNN."""
        dpt: tuple[Width, Width, Width, Width] = (48, 96, 192, 384)
        """Channels of both DPT heads at 1/2, 1/4, 1/8 and 1/16; ViT-B: 96, 192, 384, 768; ViT-L:
        128, 256, 512, 1024."""
        features: int = Field(default=64, ge=4, multiple_of=4)
        """Channels of full-size features, twice those of the DPT head that corrects depths; ViT-B:
        96, ViT-L: 128."""
        regressor: int = Field(default=64, ge=1)
        """Channels between the two networks that predict Gaussians."""
        sh_degree: int = Field(default=2, ge=0, le=SH_DEGREE)
        """Degree of the spherical harmonics."""
        coarse_depth: bool = False
        """Whether the memory also has the first sweep's depth, for `mvsplat/two_depths`."""

    config: Config

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        channels = predicted(config.sh_degree).shape[0] + int(config.coarse_depth)
        return {"memory.features": FieldSpec((channels,)), **memory_fields("grid")}

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        if config.far <= config.near:
            reason = f"far must be beyond near, got near {config.near:g} and far {config.far:g}"
            yield Problem("far", reason, "give the depths at which the scene begins and ends")
        if list(config.blocks) != sorted(set(config.blocks)) or config.blocks[0] < 0:
            yield Problem("blocks", "blocks must ascend from 0", "write such as [2, 5, 8, 11]")
        if config.blocks[-1] >= config.vit.depth:
            reason = (
                f"block {config.blocks[-1]} does not exist in a ViT of depth {config.vit.depth}"
            )
            yield Problem("blocks", reason, "number blocks from 0, or raise vit.depth")
        if config.coarse_depth and config.scales == 1:
            reason = "with one scale there is no coarse depth"
            yield Problem("coarse_depth", reason, "write false, or set scales to 2")
        unit = 8 * config.scales
        if context.dims.width % unit:
            reason = (
                f"a width of {context.dims.width} is no multiple of {unit}, groups of its norms"
            )
            yield Problem("", reason, "set model.width to a multiple, published 128")
        yield from size_problems(_multiple(config), context)

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        vit = config.vit
        sizes = Sizes(
            width=dims.width,
            cnn=config.cnn,
            candidates=config.candidates,
            scales=config.scales,
            stride=config.stride,
            neighbours=config.neighbours,
            vit=(vit.width, vit.depth, vit.heads),
            blocks=config.blocks,
            dpt=config.dpt,
            features=config.features,
            regressor=config.regressor,
            harmonics=coefficients(config.sh_degree),
        )
        self.network = DepthSplat(sizes)

    def load_pretrained(self) -> None:
        if self.config.vit.weights is not None:
            load_weights(self.network.depth_predictor.pretrained, self.config.vit.weights)

    def decays(self, name: str, parameter: nn.Parameter) -> bool:
        """Weight decay on everything (released code)."""
        return True

    def forward(self, views: Views) -> ImageMemory:
        """Raises ValueError for images that the U-Nets and windows do not divide."""
        check_size(views, _multiple(self.config))
        scenes, count = views.cameras.shape
        near, far = (
            views.cameras.c2w.new_full((scenes, count), x)
            for x in (self.config.near, self.config.far)
        )
        features = rearrange(self.predict(views, near, far), "b v c h w -> b (v h w) c")
        return ImageMemory(features, grid=(count, *views.cameras.size))

    def predict(self, views: Views, near_BV: Tensor, far_BV: Tensor) -> Tensor:
        """Numbers of every pixel (B, V, C, H, W), for depths between `near` and `far`."""
        depths, raw_BVCHW = self.network(views.images, views.cameras, near_BV, far_BV)
        raw_BVCHW = at_least_float32(raw_BVCHW)
        first = GAUSSIAN_CHANNELS
        gaussian, sh_BV3KHW = raw_BVCHW[:, :, :first], raw_BVCHW[:, :, first:].unflatten(2, (3, -1))
        constant = sh_BV3KHW[:, :, :, :1] + ((views.images - 0.5) / SH_C0)[:, :, :, None]
        sh_BV3KHW = torch.cat([constant, sh_BV3KHW[:, :, :, 1:]], 3)
        logs = [depth[:, :, None].log() for depth in depths]
        coarse = logs[:1] if self.config.coarse_depth else []
        return torch.cat([logs[-1], gaussian, sh_BV3KHW.flatten(2, 3), *coarse], 2)


def _multiple(config: DepthSplatEncoder.Config) -> int:
    """What sides of images are multiples of: the U-Nets halve the features of each sweep."""
    return 4 * config.stride

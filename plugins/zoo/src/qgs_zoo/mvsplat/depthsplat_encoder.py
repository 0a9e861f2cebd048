"""`mvsplat/depthsplat`: DepthSplat's networks as an encoder that gives each pixel a token."""

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from qgs.contracts import ModelDims, Problem, RecipeContext
from qgs.geometry.harmonics import SH_C0
from qgs.precision import at_least_float32
from qgs.types import Views
from qgs_zoo.mvsplat.adapter import coefficients
from qgs_zoo.mvsplat.depthsplat import (
    GAUSSIAN_CHANNELS,
    DepthSplat,
    DepthSplatConfig,
    nearest_neighbours,
)
from qgs_zoo.mvsplat.pixels import WIDTHS, degree_of
from qgs_zoo.mvsplat.sweep import DepthRange, Sweep, SweepEncoder


class DepthSplatEncoder(SweepEncoder):
    """Encoder that predicts depth and raw Gaussian of each pixel, with a plane sweep and a ViT.

    The ViT is pretrained. The memory has a token for each pixel. The D numbers of a token are those
    of `qgs_zoo.mvsplat.pixels.CHANNELS`, then coefficients of harmonics. The pixel's colour is
    added to the constant coefficient. D is the model's width: 38 for harmonics of degree 2
    (published). In a wider model, tokens have zeros at the end.
    """

    name = "depthsplat"

    class Config(DepthSplatConfig, DepthRange):
        coarse_depth: bool = False
        """Store the logarithm of the first sweep's depth in the last of a token's D numbers, for
        the decoder layer `mvsplat/exchange`. This needs `scales: 2`, and one more channel in
        `model.width` (published: 39)."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        if config.coarse_depth and config.scales == 1:
            reason = "with `scales: 1` there is no coarse depth"
            yield Problem("coarse_depth", reason, "write false, or set scales to 2")
        if config.coarse_depth and context.dims.width in WIDTHS:
            width = context.dims.width
            reason = f"the {width} numbers of a token leave none for a coarse depth"
            yield Problem("coarse_depth", reason, f"set model.width to {width + 1}")
        if config.features % (32 * config.scales):
            reason = f"{config.features} features do not split into heads of 32 in both sweeps"
            yield Problem("features", reason, "write a multiple of 64")
        yield from super().problems(config, context)

    @classmethod
    def multiple(cls, config: Config) -> int:
        # The U-Nets halve the features of each sweep.
        return 4 * config.stride

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.network = DepthSplat(config, coefficients(degree_of(dims.width)))

    def load_pretrained(self) -> None:
        self.network.depth_predictor.pretrained.load(self.config.vit.weights)

    def decays(self, name: str, parameter: nn.Parameter) -> bool:
        """Return True, because all parameters have weight decay (released code)."""
        return True

    def predict(self, views: Views, near_BV: Tensor, far_BV: Tensor) -> Tensor:
        # Chosen once: both scales and the transformer read the same views.
        neighbours = nearest_neighbours(views.cameras.c2w, self.config.neighbours)
        sweep = Sweep(views.cameras, neighbours, near_BV, far_BV)
        depths, raw_BVCHW = self.network(views.images, sweep)
        gaussian, sh_BVCHW = at_least_float32(raw_BVCHW).tensor_split([GAUSSIAN_CHANNELS], 2)
        sh_BV3KHW = sh_BVCHW.unflatten(2, (3, -1))
        # The pixel's colour is added to the constant: an untrained network copies the photo.
        constant = sh_BV3KHW[:, :, :, :1] + ((views.images - 0.5) / SH_C0)[:, :, :, None]
        sh_BV3KHW = torch.cat([constant, sh_BV3KHW[:, :, :, 1:]], 3)
        # Logarithms of depths have about the range of features.
        logs = [depth[:, :, None].log() for depth in depths]
        numbers = torch.cat([logs[-1], gaussian, sh_BV3KHW.flatten(2, 3)], 2)
        # It is the last number, where `mvsplat/exchange` expects it.
        coarse = logs[:1] if self.config.coarse_depth else []
        left = self.dims.width - numbers.shape[2] - len(coarse)
        return torch.cat([F.pad(numbers, (0, 0, 0, 0, 0, left)), *coarse], 2)

"""`mvsplat/gaussians`, `mvsplat/depthsplat_gaussians`: activations of the numbers of each pixel."""

from abc import abstractmethod
from collections.abc import Iterable
from typing import ClassVar

import torch
import torch.nn.functional as F
from einops import rearrange
from pydantic import Field
from torch import Tensor

from qgs.contracts import ComponentConfig, Fields, Head, Problem, RecipeContext
from qgs.contracts.head import GAUSSIAN_FIELDS
from qgs.geometry.harmonics import SH_C0
from qgs.precision import full_precision
from qgs.types import GaussianAttributes, QueryState
from qgs_zoo.mvsplat.adapter import SH_DEGREE, camera_quaternions, coefficients, world_quaternions
from qgs_zoo.mvsplat.pixels import (
    CHANNELS,
    PIXEL,
    PIXEL_FIELDS,
    TURN,
    degree_of,
    depths,
    numbers_of,
    width_problems,
)

SCALE_FACTOR = 0.1
SCALE_SHIFT = 4.0
"""Taken off a raw scale of DepthSplat, so that scales start at softplus(-4) = 0.018."""


class PixelHead(Head):
    """One Gaussian for each query of `mvsplat/pixels`; it has no parameters."""

    writes: ClassVar[Fields] = {"gaussians.sh": GAUSSIAN_FIELDS["gaussians.sh"]}

    @abstractmethod
    def scales(self, raw: Tensor, log_depth: Tensor, state: QueryState) -> Tensor:
        """World units (B, N, 1, 3)."""

    def opacities(self, p: Tensor) -> Tensor:
        """Of the sigmoids p of the logits."""
        return p

    @property
    def gaussians_per_query(self) -> int:
        return 1

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        return width_problems(context)

    @full_precision
    def forward(self, state: QueryState) -> GaussianAttributes:
        raw_BN1C = numbers_of(state.features)[:, :, None, : sum(CHANNELS)]
        sh = harmonics_of(state.features)[:, :, None]
        log_depth, logit, place, scale, rotation = raw_BN1C.split(CHANNELS, -1)
        return GaussianAttributes(
            offsets=torch.cat([place, log_depth], -1),
            scales=self.scales(scale, log_depth, state),
            quats=world_quaternions(camera_quaternions(rotation), state[TURN][:, :, None]),
            opacities=self.opacities(logit[..., 0].sigmoid()),
            # Zeros are grey in MVSplat; DepthSplat's have the colour of the photo in them already.
            colors=0.5 + SH_C0 * sh[..., 0, :],
            sh=sh[..., 1:, :].clone(),
        )


class RayHead(PixelHead):
    """MVSplat's activations.

    Scales are (min + (max - min) sigmoid) * t * .1 * (1 / fx + 1 / fy), focal lengths in pixels:
    a sum over both axes, no mean. The opacity p is that of a sigmoid, then
    (1 - (1 - p)^e + p^(1 / e)) / 2 with e = 2^opacity_exponent.
    """

    name = "gaussians"
    scheduled = frozenset({"opacity_exponent"})
    reads = PIXEL_FIELDS

    class Config(ComponentConfig):
        scale_min: float = Field(default=0.5, gt=0)
        """Least standard deviation, tenths of the size that two pixels have at its depth."""
        scale_max: float = Field(default=15.0, gt=0)
        """Largest standard deviation, likewise."""
        opacity_exponent: float = Field(default=0.0, ge=-10, le=10)
        """Exponent of the opacity map as a power of 2; 0 for none (published)."""

    config: Config

    def scales(self, raw: Tensor, log_depth: Tensor, state: QueryState) -> Tensor:
        # Between scale_min and scale_max pixels at the Gaussian's own depth.
        least = self.config.scale_min
        factor = least + (self.config.scale_max - least) * raw.sigmoid()
        # The lengths of the steps across and down a pixel, at depth 1.
        size = SCALE_FACTOR * state[PIXEL][:, :, 2:].norm(dim=-1).sum(-1)[..., None, None]
        return factor * depths(log_depth) * size

    def opacities(self, p: Tensor) -> Tensor:
        return mapped_opacity(p, self.config.opacity_exponent)


class WorldHead(PixelHead):
    """DepthSplat's: scales are softplus(x - 4), whatever the depth and the size of a pixel."""

    name = "depthsplat_gaussians"
    reads: ClassVar[Fields] = {TURN: PIXEL_FIELDS[TURN]}

    class Config(ComponentConfig):
        scale_min: float = Field(default=1e-10, gt=0)
        """Least standard deviation, world units."""
        scale_max: float = Field(default=3.0, gt=0)
        """Largest standard deviation, world units; 0.1 in the demos at 512 x 960."""

    config: Config

    def scales(self, raw: Tensor, log_depth: Tensor, state: QueryState) -> Tensor:
        return F.softplus(raw - SCALE_SHIFT).clamp(self.config.scale_min, self.config.scale_max)


def harmonics_of(features_BND: Tensor) -> Tensor:
    """Coefficients (B, N, K, 3) in the numbers of pixels, of degrees that are rendered."""
    degree = degree_of(features_BND.shape[-1])
    first = sum(CHANNELS)
    sh_BNC = numbers_of(features_BND)[..., first : first + 3 * coefficients(degree)]
    sh_BNK3 = rearrange(sh_BNC, "b n (x k) -> b n k x", x=3)
    return sh_BNK3[..., : coefficients(min(degree, SH_DEGREE)), :]


def mapped_opacity(p: Tensor, exponent: float) -> Tensor:
    """Opacities of probabilities; those themselves for an exponent of 0."""
    if exponent == 0:
        return p
    # The mean of two curves, which is p for an exponent of 0, that of the published weights. The
    # released code has the map from pixelSplat, where it sharpens opacities while training.
    power = 2.0**exponent
    inside = (p > 0) & (p < 1)
    # 0 and 1 stay as they are; there the slope of the map may be infinite.
    q = torch.where(inside, p, 0.5)
    return torch.where(inside, 0.5 * (1 - (1 - q) ** power + q ** (1 / power)), p)

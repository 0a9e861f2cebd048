"""`mvsplat/gaussians`, `mvsplat/depthsplat_gaussians`: heads that activate each pixel's numbers."""

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
"""Number subtracted from DepthSplat's raw scales, which then start at softplus(-4) = 0.018."""


class PixelHead(Head):
    """Head without parameters that makes one Gaussian of each query of `mvsplat/pixels`."""

    writes: ClassVar[Fields] = {"gaussians.sh": GAUSSIAN_FIELDS["gaussians.sh"]}

    @abstractmethod
    def scales(self, raw: Tensor, log_depth: Tensor, state: QueryState) -> Tensor:
        """Return scales (B, N, 1, 3), world units."""

    def opacities(self, p: Tensor) -> Tensor:
        """Return opacities from the sigmoids p of the logits."""
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
            # Zeros are grey in MVSplat; DepthSplat has already added the colour of the photo.
            colors=0.5 + SH_C0 * sh[..., 0, :],
            sh=sh[..., 1:, :].clone(),
        )


class RayHead(PixelHead):
    """MVSplat's activations.

    Scales are (min + (max - min) sigmoid) * t * .1 * (1 / fx + 1 / fy), with focal lengths in
    pixels; both axes are summed, not averaged. With p the sigmoid of the logit, opacities are
    (1 - (1 - p)^e + p^(1 / e)) / 2 with e = 2^opacity_exponent.
    """

    name = "gaussians"
    scheduled = frozenset({"opacity_exponent"})
    reads = PIXEL_FIELDS

    class Config(ComponentConfig):
        scale_min: float = Field(default=0.5, gt=0)
        """Least standard deviation, in tenths of the width plus the height of a pixel at the
        Gaussian's depth."""
        scale_max: float = Field(default=15.0, gt=0)
        """Largest standard deviation, in the same unit."""
        opacity_exponent: float = Field(default=0.0, ge=-10, le=10)
        """Base-2 logarithm of the exponent e of the opacity map. 0 leaves opacities unchanged
        (published)."""

    config: Config

    def scales(self, raw: Tensor, log_depth: Tensor, state: QueryState) -> Tensor:
        # From scale_min to scale_max, in pixels at the Gaussian's own depth.
        least = self.config.scale_min
        factor = least + (self.config.scale_max - least) * raw.sigmoid()
        # Width plus height of a pixel at depth 1.
        size = SCALE_FACTOR * state[PIXEL][:, :, 2:].norm(dim=-1).sum(-1)[..., None, None]
        return factor * depths(log_depth) * size

    def opacities(self, p: Tensor) -> Tensor:
        return mapped_opacity(p, self.config.opacity_exponent)


class WorldHead(PixelHead):
    """DepthSplat's activations: scales are softplus(x - 4), for any depth and size of a pixel."""

    name = "depthsplat_gaussians"
    reads: ClassVar[Fields] = {TURN: PIXEL_FIELDS[TURN]}

    class Config(ComponentConfig):
        scale_min: float = Field(default=1e-10, gt=0)
        """Least standard deviation, world units."""
        scale_max: float = Field(default=3.0, gt=0)
        """Largest standard deviation, world units. The demos at 512 x 960 use 0.1."""

    config: Config

    def scales(self, raw: Tensor, log_depth: Tensor, state: QueryState) -> Tensor:
        return F.softplus(raw - SCALE_SHIFT).clamp(self.config.scale_min, self.config.scale_max)


def harmonics_of(features_BND: Tensor) -> Tensor:
    """Return the coefficients (B, N, K, 3) of rendered degrees from the numbers of pixels."""
    degree = degree_of(features_BND.shape[-1])
    first = sum(CHANNELS)
    sh_BNC = numbers_of(features_BND)[..., first : first + 3 * coefficients(degree)]
    sh_BNK3 = rearrange(sh_BNC, "b n (x k) -> b n k x", x=3)
    return sh_BNK3[..., : coefficients(min(degree, SH_DEGREE)), :]


def mapped_opacity(p: Tensor, exponent: float) -> Tensor:
    """Return opacities for probabilities p; an exponent of 0 gives p itself."""
    if exponent == 0:
        return p
    # The mean of two curves, which is p for an exponent of 0 (published weights). The released code
    # took the map from pixelSplat, which uses it to sharpen opacities during training.
    power = 2.0**exponent
    inside = (p > 0) & (p < 1)
    # 0 and 1 stay as they are, because the slope of the map may be infinite there.
    q = torch.where(inside, p, 0.5)
    return torch.where(inside, 0.5 * (1 - (1 - q) ** power + q ** (1 / power)), p)

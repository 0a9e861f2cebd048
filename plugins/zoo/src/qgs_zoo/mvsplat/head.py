"""`mvsplat/gaussians`, `mvsplat/depthsplat_gaussians`: heads that turn raw numbers into Gaussians.

Each pixel has raw numbers, which a head turns into the attributes of one Gaussian.
"""

from abc import abstractmethod
from collections.abc import Iterable
from typing import ClassVar

import torch
import torch.nn.functional as F
from einops import rearrange
from pydantic import Field, PositiveFloat
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
    """Base of heads without parameters that turn each query of `mvsplat/pixels` into a Gaussian."""

    writes: ClassVar[Fields] = {"gaussians.sh": GAUSSIAN_FIELDS["gaussians.sh"]}

    @abstractmethod
    def scales(self, raw: Tensor, log_depth: Tensor, state: QueryState) -> Tensor:
        """Return scales (B, N, 1, 3) in world units, from raw scales and logarithms of depths."""

    def opacities(self, p: Tensor) -> Tensor:
        """Return the opacities of Gaussians. p: sigmoids of raw opacities."""
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
    """Head of MVSplat: scales are proportional to the size of a pixel at the Gaussian's depth.

    Scales are (scale_min + (scale_max - scale_min) sigmoid(raw)) * 0.1 t (1 / fx + 1 / fy), with t
    the depth and fx, fy the focal lengths in pixels. Opacities are (1 - (1 - p)^e + p^(1 / e)) / 2,
    with p the sigmoid of the logit and e = 2^opacity_exponent.
    """

    name = "gaussians"
    scheduled = frozenset({"opacity_exponent"})
    reads = PIXEL_FIELDS

    class Config(ComponentConfig):
        scale_min: PositiveFloat = 0.5
        """Least scale of a Gaussian. The unit is 0.1 times the sum of width and height of a pixel
        at the Gaussian's depth."""
        scale_max: PositiveFloat = 15.0
        """Largest scale of a Gaussian. The unit is 0.1 times the sum of width and height of a pixel
        at the Gaussian's depth."""
        opacity_exponent: float = Field(default=0.0, ge=-10, le=10)
        """Base-2 logarithm of e in the opacity (1 - (1 - p)^e + p^(1 / e)) / 2, with p the sigmoid
        of the logit. 0 gives p (published)."""

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
    """Head of DepthSplat: scales do not depend on the depth and size of a pixel.

    Scales are softplus(raw - 4), bounded by `scale_min` and `scale_max`.
    """

    name = "depthsplat_gaussians"
    reads: ClassVar[Fields] = {TURN: PIXEL_FIELDS[TURN]}

    class Config(ComponentConfig):
        scale_min: PositiveFloat = 1e-10
        """Least scale of a Gaussian, in world units."""
        scale_max: PositiveFloat = 3.0
        """Largest scale of a Gaussian, in world units. DepthSplat's demos at 512 x 960 use 0.1."""

    config: Config

    def scales(self, raw: Tensor, log_depth: Tensor, state: QueryState) -> Tensor:
        return F.softplus(raw - SCALE_SHIFT).clamp(self.config.scale_min, self.config.scale_max)


def harmonics_of(features_BND: Tensor) -> Tensor:
    """Return the coefficients (B, N, K, 3) of K harmonics from the features of pixels.

    Harmonics of degrees above 3 are left out, because they are not rendered.
    """
    degree = degree_of(features_BND.shape[-1])
    first = sum(CHANNELS)
    sh_BNC = numbers_of(features_BND)[..., first : first + 3 * coefficients(degree)]
    sh_BNK3 = rearrange(sh_BNC, "b n (x k) -> b n k x", x=3)
    return sh_BNK3[..., : coefficients(min(degree, SH_DEGREE)), :]


def mapped_opacity(p: Tensor, exponent: float) -> Tensor:
    """Return opacities (1 - (1 - p)^e + p^(1 / e)) / 2 from sigmoids p, with e = 2^exponent."""
    if exponent == 0:
        return p
    # The mean of two curves, which is p for an exponent of 0 (published weights). The released code
    # took the map from pixelSplat, which uses it to sharpen opacities during training.
    power = 2.0**exponent
    inside = (p > 0) & (p < 1)
    # 0 and 1 stay as they are, because the slope of the map may be infinite there.
    q = torch.where(inside, p, 0.5)
    return torch.where(inside, 0.5 * (1 - (1 - q) ** power + q ** (1 / power)), p)

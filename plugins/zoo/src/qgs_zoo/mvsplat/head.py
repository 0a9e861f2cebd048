"""`mvsplat/gaussians`: the activations of MVSplat's numbers for each pixel."""

from collections.abc import Iterable
from typing import ClassVar

import torch
from einops import rearrange
from pydantic import Field
from torch import Tensor

from qgs.contracts import ComponentConfig, Fields, Head, Problem, RecipeContext
from qgs.contracts.head import GAUSSIAN_FIELDS
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.precision import full_precision
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


class RayHead(Head):
    """One Gaussian for each query of `mvsplat/pixels`; it has no parameters.

    Scales are (min + (max - min) sigmoid) * t * .1 * (1 / fx + 1 / fy), focal lengths in pixels:
    a sum over both axes, no mean. The opacity p is that of a sigmoid, then
    (1 - (1 - p)^e + p^(1 / e)) / 2 with e = 2^opacity_exponent.
    """

    name = "gaussians"
    scheduled = frozenset({"opacity_exponent"})

    reads = PIXEL_FIELDS
    writes: ClassVar[Fields] = {"gaussians.sh": GAUSSIAN_FIELDS["gaussians.sh"]}

    class Config(ComponentConfig):
        scale_min: float = Field(default=0.5, gt=0)
        """Least standard deviation, tenths of the size that two pixels have at its depth."""
        scale_max: float = Field(default=15.0, gt=0)
        """Largest standard deviation, likewise."""
        opacity_exponent: float = Field(default=0.0, ge=-10, le=10)
        """Exponent of the opacity map as a power of 2; 0 for none (published)."""

    config: Config

    @property
    def gaussians_per_query(self) -> int:
        return 1

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        return width_problems(context)

    def forward(self, state: QueryState) -> GaussianAttributes:
        return _decoded(state.features, state[PIXEL], state[TURN], self.config)


@full_precision
def _decoded(
    features_BND: Tensor, pixel_BN43: Tensor, turn_BN4: Tensor, config: RayHead.Config
) -> GaussianAttributes:
    raw_BN1C = numbers_of(features_BND)[:, :, None, : sum(CHANNELS)]
    sh = harmonics_of(features_BND)[:, :, None]
    log_depth, logit, place, scale, rotation = raw_BN1C.split(CHANNELS, -1)
    # Between scale_min and scale_max pixels at the Gaussian's own depth.
    factor = config.scale_min + (config.scale_max - config.scale_min) * scale.sigmoid()
    # The lengths of the steps across and down a pixel, at depth 1.
    size = SCALE_FACTOR * pixel_BN43[:, :, 2:].norm(dim=-1).sum(-1)[..., None, None]
    return GaussianAttributes(
        offsets=torch.cat([place, log_depth], -1),
        scales=factor * depths(log_depth) * size,
        quats=world_quaternions(camera_quaternions(rotation), turn_BN4[:, :, None]),
        opacities=mapped_opacity(logit[..., 0].sigmoid(), config.opacity_exponent),
        # Nothing is added for the colour of the photo: zeros are grey.
        colors=0.5 + SH_C0 * sh[..., 0, :],
        sh=sh[..., 1:, :].clone(),
    )


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

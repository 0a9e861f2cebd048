"""`mvsplat/depthsplat_gaussians`: the activations of DepthSplat's numbers for each pixel."""

from collections.abc import Iterable
from typing import ClassVar

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from qgs.contracts import ComponentConfig, Fields, Head, Problem, RecipeContext
from qgs.contracts.head import GAUSSIAN_FIELDS
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.precision import full_precision
from qgs.types import GaussianAttributes, QueryState
from qgs_zoo.mvsplat.adapter import camera_quaternions, world_quaternions
from qgs_zoo.mvsplat.head import harmonics_of
from qgs_zoo.mvsplat.pixels import CHANNELS, PIXEL_FIELDS, TURN, numbers_of, width_problems

SCALE_SHIFT = 4.0
"""Taken off a raw scale, so that scales start at softplus(-4) = 0.018."""


class WorldHead(Head):
    """One Gaussian for each query of `mvsplat/pixels`; it has no parameters.

    Scales are softplus(x - 4) in world units, whatever the depth and the size of a pixel.
    """

    name = "depthsplat_gaussians"
    reads: ClassVar[Fields] = {TURN: PIXEL_FIELDS[TURN]}
    writes: ClassVar[Fields] = {"gaussians.sh": GAUSSIAN_FIELDS["gaussians.sh"]}

    class Config(ComponentConfig):
        scale_min: float = Field(default=1e-10, gt=0)
        """Least standard deviation, world units."""
        scale_max: float = Field(default=3.0, gt=0)
        """Largest standard deviation, world units; 0.1 in the demos at 512 x 960."""

    config: Config

    @property
    def gaussians_per_query(self) -> int:
        return 1

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        return width_problems(context)

    def forward(self, state: QueryState) -> GaussianAttributes:
        return _decoded(state.features, state[TURN], self.config)


@full_precision
def _decoded(
    features_BND: Tensor, turn_BN4: Tensor, config: WorldHead.Config
) -> GaussianAttributes:
    raw_BN1C = numbers_of(features_BND)[:, :, None, : sum(CHANNELS)]
    sh = harmonics_of(features_BND)[:, :, None]
    log_depth, logit, place, scale, rotation = raw_BN1C.split(CHANNELS, -1)
    return GaussianAttributes(
        offsets=torch.cat([place, log_depth], -1),
        scales=F.softplus(scale - SCALE_SHIFT).clamp(config.scale_min, config.scale_max),
        quats=world_quaternions(camera_quaternions(rotation), turn_BN4[:, :, None]),
        opacities=logit[..., 0].sigmoid(),
        # The colour of the photo is in the constant already.
        colors=0.5 + SH_C0 * sh[..., 0, :],
        sh=sh[..., 1:, :].clone(),
    )

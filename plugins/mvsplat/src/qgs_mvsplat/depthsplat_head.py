"""`mvsplat/depthsplat_gaussians`: the activations of DepthSplat's numbers for each pixel."""

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from qgs.contracts import Fields, Head
from qgs.contracts.head import GAUSSIAN_FIELDS
from qgs.geometry.precision import full_precision
from qgs.types import GaussianAttributes, QueryState
from qgs_mvsplat.adapter import camera_quaternions, world_quaternions
from qgs_mvsplat.head import split_harmonics
from qgs_mvsplat.pixels import CHANNELS, PIXEL_FIELDS, TURN, FromPixels, turned

SCALE_SHIFT = 4.0
"""Taken off a raw scale, so that scales start at softplus(-4) = 0.018."""


class WorldHead(Head):
    """One Gaussian for each query of `mvsplat/pixels`; it has no parameters.

    Scales are softplus(x - 4) in world units, whatever the depth and the size of a pixel.
    """

    name = "depthsplat_gaussians"

    class Config(FromPixels):
        sh_degree: int = Field(default=2, ge=0, le=4)
        """Degree of the spherical harmonics that are predicted, as of the encoder; those above 3
        are not rendered."""
        scale_min: float = Field(default=1e-10, gt=0)
        """Least standard deviation, world units."""
        scale_max: float = Field(default=3.0, gt=0)
        """Largest standard deviation, world units; 0.1 in the demos at 512 x 960."""

    config: Config

    @property
    def gaussians_per_query(self) -> int:
        return 1

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        return {"state.features": turned(config.sh_degree), TURN: PIXEL_FIELDS[TURN]}

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        return {"gaussians.sh": GAUSSIAN_FIELDS["gaussians.sh"]} if config.sh_degree else {}

    def forward(self, state: QueryState) -> GaussianAttributes:
        return _decoded(state.features, state[TURN], self.config)


@full_precision
def _decoded(
    features_BNC: Tensor, turn_BN4: Tensor, config: WorldHead.Config
) -> GaussianAttributes:
    raw_BN1C = features_BNC[:, :, None]
    parts = raw_BN1C.split([*CHANNELS, raw_BN1C.shape[-1] - sum(CHANNELS)], -1)
    log_depth, logit, place, scale, rotation, sh = parts
    colors, sh = split_harmonics(sh)
    return GaussianAttributes(
        offsets=torch.cat([place, log_depth], -1),
        scales=F.softplus(scale - SCALE_SHIFT).clamp(config.scale_min, config.scale_max),
        quats=world_quaternions(camera_quaternions(rotation), turn_BN4[:, :, None]),
        opacities=logit[..., 0].sigmoid(),
        colors=colors,
        sh=sh,
    )

"""`landmark/footprint`, `landmark/colored`: Gaussians that start as the photo's square they see."""

import torch
from pydantic import Field
from qgs_locus.decoding import RadiusScaledCenters
from qgs_locus.fields import RAW_RADIUS, RadiusOptions, radius_field, support_radius
from torch import Tensor

from qgs.components import GaussianHead
from qgs.components.head import CHANNELS
from qgs.contracts import Fields
from qgs.geometry.precision import at_least_float32, full_precision
from qgs.types import GaussianAttributes, QueryState
from qgs_landmark.fields import COLORS, PLANE, footprint_fields
from qgs_landmark.places import cells

COLOR_MARGIN = 0.02
"""Colours of photos keep this far from 0 and 1, where no step would change them."""


class FootprintCenters(RadiusScaledCenters):
    """mean = mu + r (u e_x + v e_y + posact(offset)), (u, v) the middle of the Gaussian's cell.

    e_x and e_y are the photo's directions to the right and down. Where the radius is the side of
    the footprint, offsets of 0 put each Gaussian onto the ray of its cell.
    """

    name = "footprint"

    class Config(RadiusScaledCenters.Config):
        cells: int = Field(default=4, ge=1)
        """K, the Gaussians of a query, as its head makes them."""

    config: Config

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        """Anchors, and the directions of their photos."""
        plane = {PLANE: footprint_fields(config.cells)[PLANE]}
        return {**super().fields_read(config), **plane}

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """(B, N, K, 3) -> (B, N, K, 3)."""
        means_BNK3 = super().forward(offsets, state)
        r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        return means_BNK3 + on_plane(state[PLANE], offsets.shape[2], r_BN1)


@full_precision
def on_plane(plane_BN23: Tensor, count: int, side_BN1: Tensor) -> Tensor:
    """Middles of `count` cells of squares about 0 of some sides: (B, N, K, 3)."""
    return side_BN1[:, :, None] * (cells(count).to(plane_BN23) @ plane_BN23)


class ColoredHead(GaussianHead):
    """`qgs/gaussian_head` whose raw colours of 0 are those of the photo, whose scales are in radii.

    The colour of a Gaussian is (tanh(raw + atanh(2 c - 1)) + 1) / 2, c that of its cell.
    """

    name = "colored"

    class Config(GaussianHead.Config, RadiusOptions):
        gaussians_per_query: int = Field(default=4, ge=1)
        """K, the Gaussians of each query; `cells` of the queries is the same."""
        scale_cap: float = Field(default=0.8, gt=0)
        """Largest scale, in radii of the anchor; a raw scale of 0 gives 1/e of it."""

    config: Config

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        """Colours and radii."""
        colors = {COLORS: footprint_fields(config.gaussians_per_query)[COLORS]}
        return {**colors, **radius_field(config)}

    def forward(self, state: QueryState) -> GaussianAttributes:
        raw_BNC = at_least_float32(self.linear(self.norm(state.features)))
        position, rgb, rest = raw_BNC.unflatten(-1, (-1, sum(CHANNELS))).tensor_split([3, 6], -1)
        seen_BNK3 = state[COLORS].clamp(COLOR_MARGIN, 1 - COLOR_MARGIN)
        raw_BNKC = torch.cat([position, rgb + torch.atanh(2 * seen_BNK3 - 1), rest], -1)
        found = self.activate(raw_BNKC)
        r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        return found.replace(scales=found.scales * r_BN1[:, :, None])

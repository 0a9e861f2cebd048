"""`landmark/footprint`, `landmark/colored`: Gaussians that start as pixels of a photo.

`landmark/refine`: LocusGS's refinement, with steps in radii along the axes of the photo.
"""

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from pydantic import Field
from qgs_locus.decoding import RadiusScaledCenters
from qgs_locus.fields import CENTER, RAW_RADIUS, RadiusOptions, radius_field, support_radius
from qgs_locus.refinement import AnchorRefinement
from torch import Tensor

from qgs.contracts import Fields
from qgs.precision import at_least_float32
from qgs.tokengs import GaussianHead
from qgs.tokengs.head import CHANNELS
from qgs.types import GaussianAttributes, QueryState
from qgs_anchors.landmark.fields import (
    COLORS,
    FOOTPRINT,
    FOOTPRINT_FIELD,
    FRAME,
    FRAME_FIELD,
    color_field,
    in_world,
)
from qgs_anchors.landmark.places import cells, rows_in_square

COLOR_MARGIN = 0.02
"""Least distance of initial colours from 0 and 1, where they would get no gradient."""

_OF_CHANNELS = ("linear.weight", "linear.bias")


class FootprintCenters(RadiusScaledCenters):
    """Means at mu + r (u, v, 0) + r posact(offset), in the frame of the anchor's photo.

    (u, v) is the centre of the Gaussian's cell relative to the centre of the footprint. Its unit is
    the side of a square with the area of the footprint. If the radius equals that side, offsets of
    0 put each Gaussian on the ray of its cell.
    """

    name = "footprint"

    @classmethod
    def fields_read(cls, config: RadiusScaledCenters.Config) -> Fields:
        """Return anchors, the axes of their photos, and their footprints."""
        return {**super().fields_read(config), **FRAME_FIELD, **FOOTPRINT_FIELD}

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """Return means (B, N, K, 3) for raw offsets (B, N, K, 3)."""
        count = offsets.shape[2]
        size_BN2, rows_BN1 = state[FOOTPRINT].tensor_split([2], -1)
        rows = rows_BN1[0, 0, 0].round().long().clamp_max(count)
        rows = torch.where(rows > 0, rows, rows_in_square(count))
        cell_BNK2 = size_BN2[:, :, None] * cells(count, rows, offsets)
        steps_BNK3 = F.pad(cell_BNK2, (0, 1)) + self.config.displacement(offsets)
        r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        steps_BNK3 = in_world(r_BN1[:, :, None] * steps_BNK3, state[FRAME])
        return state[CENTER][:, :, None] + steps_BNK3


class ColoredHead(GaussianHead):
    """Head `qgs/gaussian_head` with colours relative to the photo and scales in radii.

    A Gaussian has the colour (tanh(raw + atanh(2 c - 1)) + 1) / 2, with c the colour of its cell.
    So raw colours of 0 give those of the photo.
    """

    name = "colored"

    class Config(GaussianHead.Config, RadiusOptions):
        gaussians_per_query: int = Field(default=4, ge=1)
        """K, the number of Gaussians of each query. It must equal `cells` of the queries."""
        scale_cap: float = Field(default=0.8, gt=0)
        """Largest scale, in radii of the anchor. A raw scale of 0 gives 1/e of it."""

    config: Config

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        """Return colours and radii."""
        return {**color_field(config.gaussians_per_query), **radius_field(config)}

    def adapted(self, learned: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Adapt the weights of a head with another number of cells.

        Each Gaussian takes the weights of the nearest cell. Both sets of cells are taken to fill a
        square, as with `count: null`; the cells of a tile may have other places.
        """
        return {
            name: self._of_cells(values) if name in _OF_CHANNELS else values
            for name, values in learned.items()
        }

    def _of_cells(self, rows: Tensor) -> Tensor:
        """Turn rows (K' * 14, ...) of other cells into rows (K * 14, ...) of this head's cells.

        Rows that do not divide into channels belong to another kind of head, and stay unchanged.
        """
        if len(rows) % sum(CHANNELS):
            return rows
        rows_KC = rows.unflatten(0, (-1, sum(CHANNELS)))
        counts = self.gaussians_per_query, len(rows_KC)
        own, theirs = (cells(k, rows_in_square(k), rows) for k in counts)
        return rows_KC[torch.cdist(own, theirs).argmin(-1)].flatten(0, 1)

    def forward(self, state: QueryState) -> GaussianAttributes:
        raw_BNC = at_least_float32(self.linear(self.norm(state.features)))
        position, rgb, rest = raw_BNC.unflatten(-1, (-1, sum(CHANNELS))).tensor_split([3, 6], -1)
        seen_BNK3 = state[COLORS].clamp(COLOR_MARGIN, 1 - COLOR_MARGIN)
        raw_BNKC = torch.cat([position, rgb + torch.atanh(2 * seen_BNK3 - 1), rest], -1)
        found = self.activate(raw_BNKC)
        r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        return found.replace(scales=found.scales * r_BN1[:, :, None])


class FramedRefinement(AnchorRefinement):
    """Refinement mu += r step(MLP_mu(x)) in the frame of the photo, and rho += MLP_rho(x).

    An anchor that starts on a ray of a photo is off by some radii, mostly in depth. In the frame of
    its photo, depth is the same direction for all anchors.
    """

    name = "refine"

    @classmethod
    def fields_read(cls, config: AnchorRefinement.Config) -> Fields:
        """Return the refined fields, and frames and radii if centres are refined."""
        framed = {**FRAME_FIELD, **radius_field(config)} if config.center else {}
        return {**super().fields_read(config), **framed}

    @classmethod
    def fields_written(cls, config: AnchorRefinement.Config) -> Fields:
        """Return the fields that are refined."""
        return super().fields_read(config)

    def center_step(self, state: QueryState) -> Tensor:
        """Return the step of the centres (B, N, 3), world frame."""
        # Steps are in radii: distant anchors, with larger radii, may move further.
        r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        return in_world(r_BN1 * super().center_step(state), state[FRAME])

"""`landmark/footprint`, `landmark/colored`: Gaussians that start on photo rays, in photo colours.

`landmark/refine`: LocusGS's update of anchors, with steps along camera axes in anchor radii.
"""

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from pydantic import PositiveFloat, PositiveInt
from qgs_locus.decoding import RadiusScaledCenters
from qgs_locus.fields import RAW_RADIUS, RadiusOptions, radius_field, support_radius
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
"""Least distance of initial colours from 0 and 1, where tanh would give them no gradient."""


class FootprintCenters(RadiusScaledCenters):
    """Gaussian means at mu + r (u, v, 0) + r posact(offset), along the axes of the photo's camera.

    mu and r are centre and radius of the anchor, which starts on a ray of a photo. A query's
    footprint is the region of the photo that the query represents; each Gaussian has a cell of it.
    (u, v) is the vector from the centre of the footprint to the centre of the cell. Its unit is a,
    the square root of the footprint's area. If r is a, projected to the anchor's depth, then an
    offset of 0 puts the Gaussian on the ray through the cell's centre. posact(t) is
    sign(t) (exp|t| - 1).
    """

    name = "footprint"

    @classmethod
    def fields_read(cls, config: RadiusScaledCenters.Config) -> Fields:
        return {**super().fields_read(config), **FRAME_FIELD, **FOOTPRINT_FIELD}

    def steps(self, displaced: Tensor, state: QueryState) -> Tensor:
        """Return steps from the centre, for displacements in radii along the camera's axes."""
        count = displaced.shape[2]
        size_BN2, rows_BN1 = state[FOOTPRINT].tensor_split([2], -1)
        rows = rows_BN1[0, 0, 0].round().long().clamp_max(count)
        rows = torch.where(rows > 0, rows, rows_in_square(count))
        cell_BNK2 = size_BN2[:, :, None] * cells(count, rows, displaced)
        steps_BNK3 = super().steps(F.pad(cell_BNK2, (0, 1)) + displaced, state)
        return in_world(steps_BNK3, state[FRAME])


class ColoredHead(GaussianHead):
    """Head `qgs/gaussian_head` with colours relative to the photo's, and scales in anchor radii.

    Each Gaussian stands for a cell of its query's footprint, a part of a photo. Its colour is
    (tanh(raw + atanh(2 c - 1)) + 1) / 2, with `raw` the head's output and c the mean colour of the
    cell. So a raw colour of 0 gives c.
    """

    name = "colored"

    class Config(GaussianHead.Config, RadiusOptions):
        gaussians_per_query: PositiveInt = 4
        """K, the number of Gaussians of each query. It must equal the option `cells` of the
        queries."""
        scale_cap: PositiveFloat = 0.8
        """Largest scale, in radii of the anchor. A raw scale of 0 gives 1/e of the largest."""

    config: Config

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        return {**color_field(config.gaussians_per_query), **radius_field(config)}

    def adapted(self, learned: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Adapt the weights `learned` of a head with a different number of Gaussians per query.

        Each Gaussian stands for a cell of a footprint. It takes the weights of the nearest cell in
        `learned`. Distances are computed with cells in a square, as in the footprints of queries
        with `count: null`. In other footprints, the cells may form other rows, so another cell may
        be nearer.
        """
        return {
            name: self._of_cells(values) if name.startswith("linear.") else values
            for name, values in learned.items()
        }

    def _of_cells(self, rows: Tensor) -> Tensor:
        """Convert head weights `rows` (K' * 14, ...) from K' to this head's K Gaussians per query.

        The result is (K * 14, ...), with 14 channels per Gaussian. Weights whose first dimension is
        not a multiple of 14 belong to another kind of head; they are returned unchanged.
        """
        if len(rows) % sum(CHANNELS):
            return rows
        rows_KC = rows.unflatten(0, (-1, sum(CHANNELS)))
        counts = self.gaussians_per_query, len(rows_KC)
        own, theirs = (cells(k, rows_in_square(k), rows) for k in counts)
        return rows_KC[torch.cdist(own, theirs).argmin(-1)].flatten(0, 1)

    def forward(self, state: QueryState) -> GaussianAttributes:
        raw_BNC = at_least_float32(self.linear(self.norm(state.features)))
        raw_BNKC = raw_BNC.unflatten(-1, (-1, sum(CHANNELS)))
        seen_BNK3 = state[COLORS].clamp(COLOR_MARGIN, 1 - COLOR_MARGIN)
        # Colours come after the position.
        start_BNKC = F.pad(torch.atanh(2 * seen_BNK3 - 1), (CHANNELS[0], sum(CHANNELS[2:])))
        found = self.activate(raw_BNKC + start_BNKC)
        r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        return found.replace(scales=found.scales * r_BN1[:, :, None])


class FramedRefinement(AnchorRefinement):
    """Update of anchors as in `locus/refine`, with steps of centres along the camera's axes.

    The unit of a step is the anchor's radius. An anchor starts on the ray of a pixel, at a distance
    of some radii from the right position, mostly because the anchor's depth is wrong. In the frame
    of the pixel's camera, depth is the z axis for all anchors.
    """

    name = "refine"

    @classmethod
    def fields_read(cls, config: AnchorRefinement.Config) -> Fields:
        framed = {**FRAME_FIELD, **radius_field(config)} if config.center else {}
        return {**super().fields_read(config), **framed}

    @classmethod
    def fields_written(cls, config: AnchorRefinement.Config) -> Fields:
        return super().fields_read(config)

    def center_step(self, state: QueryState) -> Tensor:
        """Return the steps of the centres (B, N, 3), world frame."""
        # Steps are in radii: distant anchors, with larger radii, may move further.
        r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        return in_world(r_BN1 * super().center_step(state), state[FRAME])

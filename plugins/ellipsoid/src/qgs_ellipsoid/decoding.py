"""`ellipsoid/axis_scaled`: Gaussians stand around their query's anchor, in its own frame."""

from __future__ import annotations

from typing import ClassVar

from qgs_locus.decoding import RadiusScaledCenters
from qgs_locus.fields import CENTER, CENTER_FIELD
from torch import Tensor

from qgs.contracts import Fields
from qgs.geometry.precision import full_precision
from qgs.types import QueryState
from qgs_ellipsoid.fields import anchor_axes, shape_fields


class AxisScaledCenters(RadiusScaledCenters):
    """mean = mu + R diag(r) posact(offset), with the options of `locus/radius_scaled`."""

    name: ClassVar[str] = "axis_scaled"

    @classmethod
    def requires(cls, config: RadiusScaledCenters.Config) -> Fields:
        """Centres and shapes."""
        return {**CENTER_FIELD, **shape_fields(config)}

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """(B, N, K, 3) -> (B, N, K, 3)."""
        displacement = self.config.displacement(offsets)
        return _placed(state[CENTER], anchor_axes(state, self.config), displacement)


@full_precision
def _placed(center: Tensor, axes: Tensor, displacement: Tensor) -> Tensor:
    return center[:, :, None] + displacement @ axes.mT

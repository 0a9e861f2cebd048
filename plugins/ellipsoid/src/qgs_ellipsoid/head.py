"""`ellipsoid/gaussian_head`: Gaussians that turn and grow with their anchor."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from qgs_locus.fields import RadiusOptions, support_radius
from torch import Tensor

from qgs.components import GaussianHead
from qgs.contracts import Fields
from qgs.geometry.precision import full_precision
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import GaussianAttributes, QueryState
from qgs_ellipsoid.fields import RAW_RADII, ROTATION, shape_fields
from qgs_ellipsoid.rotations import quat_product, unit_quats


class EllipsoidHead(GaussianHead):
    """`qgs/gaussian_head` whose rotations and scales are those of the anchor's frame.

    A Gaussian is turned with its anchor, and measured along each of its axes by the radius that the
    ellipsoid has in that direction: the scale s becomes s / |u / r| with u the axis in the frame of
    the anchor.
    """

    name: ClassVar[str] = "gaussian_head"

    class Config(GaussianHead.Config, RadiusOptions):
        """As `qgs/gaussian_head`; `scale_cap` is a multiple of the anchor's radius."""

    config: Config

    @classmethod
    def requires(cls, config: Config) -> Fields:
        """The shape of the anchors."""
        return shape_fields(config)

    def forward(self, state: QueryState) -> GaussianAttributes:
        """(B, N, D) and the anchors' shapes -> attributes of (B, N, K) Gaussians."""
        local = super().forward(state)
        quats = unit_quats(local.quats)
        turn = unit_quats(state[ROTATION])[:, :, None].expand_as(quats)
        scales = local.scales * radii_along(support_radius(state[RAW_RADII], self.config), quats)
        return replace(local, quats=quat_product(turn, quats), scales=scales)


@full_precision
def radii_along(radii: Tensor, quats: Tensor) -> Tensor:
    """Radii (B, N, K, 3) of ellipsoids in the directions of the axes of their Gaussians.

    radii (B, N, 3); quats (B, N, K, 4), Gaussian to anchor. A unit vector u of the anchor's frame
    leaves the ellipsoid at 1 / |u / r|.
    """
    return 1 / (quat_to_matrix(quats) / radii[:, :, None, :, None]).norm(dim=-2)

"""`ellipsoid/gaussian_head`, `ellipsoid/axis_scaled`: Gaussians relative to their anchor."""

from qgs_locus.decoding import RadiusScaledCenters
from qgs_locus.fields import CENTER, CENTER_FIELD, RadiusOptions, support_radius
from torch import Tensor

from qgs.contracts import Fields
from qgs.geometry.transforms import quat_product, quat_to_matrix, unit
from qgs.precision import full_precision
from qgs.tokengs import GaussianHead
from qgs.types import GaussianAttributes, QueryState
from qgs_anchors.ellipsoid.fields import RAW_RADII, ROTATION, anchor_axes, shape_fields


class EllipsoidHead(GaussianHead):
    """Head `qgs/gaussian_head` with rotations and scales relative to the anchor's ellipsoid.

    A Gaussian is rotated by the head's rotation, then by the anchor's. The head's scale along an
    axis of the Gaussian is multiplied by the ellipsoid's radius in the direction of this axis. This
    radius is 1 / |u / r|, with u the unit vector of the axis in the anchor's frame, and r the three
    radii.
    """

    name = "gaussian_head"

    class Config(GaussianHead.Config, RadiusOptions):
        """Options of `qgs/gaussian_head`, but with `scale_cap` in radii of the anchor."""

    config: Config

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        return shape_fields(config)

    def forward(self, state: QueryState) -> GaussianAttributes:
        """Return attributes of (B, N, K) Gaussians from features (B, N, D) and ellipsoids."""
        local = super().forward(state)
        quats = unit(local.quats)
        # The anchor's rotation comes after the Gaussian's own.
        turn = unit(state[ROTATION])[:, :, None].expand_as(quats)
        scales = local.scales * radii_along(support_radius(state[RAW_RADII], self.config), quats)
        return local.replace(quats=quat_product(turn, quats), scales=scales)


@full_precision
def radii_along(radii_BN3: Tensor, quats_BNK4: Tensor) -> Tensor:
    """Return the radii (B, N, K, 3) of ellipsoids in the directions of their Gaussians' axes.

    radii: radii along the axes of each ellipsoid. quats: rotations from Gaussian to anchor. In
    direction u of the anchor's frame an ellipsoid with radii r has the radius 1 / |u / r|.
    """
    return 1 / (quat_to_matrix(quats_BNK4) / radii_BN3[:, :, None, :, None]).norm(dim=-2)


class AxisScaledCenters(RadiusScaledCenters):
    """Gaussian means at mu + R diag(r) posact(offset), for ellipsoidal anchors.

    An anchor has the centre mu, the rotation R and the radii r. `offset` is an output of the head,
    and posact(t) is sign(t) (exp|t| - 1).
    """

    name = "axis_scaled"

    @classmethod
    def fields_read(cls, config: RadiusScaledCenters.Config) -> Fields:
        return {**CENTER_FIELD, **shape_fields(config)}

    @full_precision
    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """Return world-frame means (B, N, K, 3) for the head's raw offsets (B, N, K, 3)."""
        # Offsets are along the axes of the ellipsoid, in units of its radii.
        displaced = self.config.displacement(offsets)
        return state[CENTER][:, :, None] + displaced @ anchor_axes(state, self.config).mT

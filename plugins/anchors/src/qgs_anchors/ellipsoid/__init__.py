"""Ellipsoidal anchors for qgs: LocusGS with a rotation and three radii instead of one radius."""

from qgs.contracts import Plugin
from qgs_anchors.ellipsoid.components import (
    AxisScaledCenters,
    EllipsoidCrossAttention,
    EllipsoidHead,
    EllipsoidQueries,
    EllipsoidRefinement,
)

plugin = Plugin(
    name="ellipsoid",
    contract_version=1,
    components=(
        EllipsoidQueries,
        EllipsoidCrossAttention,
        EllipsoidRefinement,
        EllipsoidHead,
        AxisScaledCenters,
    ),
    examples=(
        EllipsoidQueries.Config(count=8, init_radii=(0.5, 1.0, 2.0), radius_bound="offset"),
        EllipsoidCrossAttention.Config(bandwidth="fixed"),
        EllipsoidRefinement.Config(center=False, zero_init=True),
        EllipsoidRefinement.Config(rotation=False, radius=False, center_step="linear"),
        AxisScaledCenters.Config(offset="linear"),
    ),
)

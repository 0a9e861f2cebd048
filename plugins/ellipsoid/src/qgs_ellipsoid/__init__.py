"""Ellipsoidal anchors for qgs: LocusGS with three radii and a rotation for its support."""

from qgs.contracts import Plugin
from qgs_ellipsoid.anchors import EllipsoidQueries
from qgs_ellipsoid.conversion import from_locus
from qgs_ellipsoid.cross_attention import EllipsoidCrossAttention
from qgs_ellipsoid.decoding import AxisScaledCenters
from qgs_ellipsoid.head import EllipsoidHead
from qgs_ellipsoid.refinement import EllipsoidRefinement

__all__ = ["from_locus", "plugin"]

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
        EllipsoidQueries.Config(count=8, init_radii=(0.5, 1.0, 2.0)),
        EllipsoidCrossAttention.Config(bandwidth="fixed"),
        EllipsoidRefinement.Config(rotation=False),
        EllipsoidRefinement.Config(radii=False),
        EllipsoidRefinement.Config(center=False, zero_init=True),
        EllipsoidRefinement.Config(center_step="linear"),
        EllipsoidHead.Config(gaussians_per_query=2, scales="world"),
        EllipsoidHead.Config(gaussians_per_query=2, rotations="world"),
        AxisScaledCenters.Config(offset="linear"),
    ),
)

"""LocusGS for qgs: each query has a 3D anchor that steers attention and places Gaussians."""

from qgs.contracts import Plugin
from qgs_locus.anchors import AnchoredQueries, FrustumCenters
from qgs_locus.cross_attention import RayBiasedCrossAttention
from qgs_locus.decoding import AnchorOffsetCenters, RadiusScaledCenters
from qgs_locus.refinement import AnchorRefinement
from qgs_locus.self_attention import AnchorAwareSelfAttention
from qgs_locus.visibility import AnchorVisibility

FRUSTUM = FrustumCenters(kind="frustum")

plugin = Plugin(
    name="locus",
    contract_version=1,
    components=(
        AnchoredQueries,
        RayBiasedCrossAttention,
        AnchorAwareSelfAttention,
        AnchorRefinement,
        AnchorOffsetCenters,
        RadiusScaledCenters,
        AnchorVisibility,
    ),
    examples=(
        AnchoredQueries.Config(radius=False),
        AnchoredQueries.Config(count=8, radius_bound="offset", center_init=FRUSTUM),
        RayBiasedCrossAttention.Config(bandwidth="fixed"),
        RayBiasedCrossAttention.Config(radius_bound="offset"),
        AnchorAwareSelfAttention.Config(position="raw"),
        AnchorRefinement.Config(radius=False),
        AnchorRefinement.Config(center=False),
        AnchorRefinement.Config(center_step="linear", zero_init=True),
        AnchorOffsetCenters.Config(offset="linear"),
        RadiusScaledCenters.Config(offset="linear"),
        AnchorVisibility.Config(behind_camera="invisible"),
    ),
)

"""LocusGS for qgs: queries with a 3D anchor that steers attention and places Gaussians."""

from qgs.contracts import Plugin
from qgs_locus.anchors import AnchoredQueries
from qgs_locus.cross_attention import RayBiasedCrossAttention
from qgs_locus.decoding import AnchorOffsetCenters, RadiusScaledCenters
from qgs_locus.layout import LOCUSGS
from qgs_locus.refinement import AnchorRefinement
from qgs_locus.self_attention import AnchorAwareSelfAttention
from qgs_locus.visibility import AnchorVisibility

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
    layouts=(LOCUSGS,),
)

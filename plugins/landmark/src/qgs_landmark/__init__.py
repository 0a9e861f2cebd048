"""Landmark for qgs: LocusGS whose anchors start at what the photos see."""

from qgs.contracts import Plugin
from qgs_landmark.observed import ObservedQueries

plugin = Plugin(
    name="landmark",
    contract_version=1,
    components=(ObservedQueries,),
    examples=(
        ObservedQueries.Config(count=None),
        ObservedQueries.Config(count=None, per_token=2, radius_bound="offset"),
    ),
)

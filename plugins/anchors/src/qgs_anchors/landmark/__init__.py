"""Landmark for qgs: LocusGS with anchors that start on surfaces which the photos show."""

from qgs.contracts import Plugin
from qgs_anchors.landmark.footprint import ColoredHead, FootprintCenters, FramedRefinement
from qgs_anchors.landmark.gradient import GradientFeedback
from qgs_anchors.landmark.neighbours import NeighbourAttention
from qgs_anchors.landmark.observed import ObservedQueries
from qgs_anchors.landmark.rendered import RenderedFeedback

plugin = Plugin(
    name="landmark",
    contract_version=1,
    components=(
        ObservedQueries,
        NeighbourAttention,
        FramedRefinement,
        RenderedFeedback,
        GradientFeedback,
        FootprintCenters,
        ColoredHead,
    ),
    examples=(
        ObservedQueries.Config(count=None),
        ObservedQueries.Config(count=None, per_token=2, radius_bound="offset"),
        ObservedQueries.Config(count=7, cells=4, sweep=6),
        ObservedQueries.Config(count=8, tokens=3, sweep=6),
        NeighbourAttention.Config(count=3, hidden=8),
        ColoredHead.Config(gaussians_per_query=6),
        FootprintCenters.Config(offset="linear"),
        FramedRefinement.Config(center=False),
        RenderedFeedback.Config(rounds=1, layers=1, shrink=1, cells=1),
    ),
    exemptions={
        GradientFeedback: {
            "gradients_match_differences": "it treats the gradient of an error as a constant",
        },
        NeighbourAttention: {
            "updates_are_explained": "its update depends on values and on positions of neighbours"
        },
    },
)

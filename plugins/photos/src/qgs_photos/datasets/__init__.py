"""Readers of data sets (pixelSplat's chunks, DL3DV, camera files) and samplers of views."""

from qgs.contracts import Plugin
from qgs_photos.datasets.chunks import ChunksSource
from qgs_photos.datasets.dl3dv import Dl3dvSource
from qgs_photos.datasets.view_samplers import Bounded, Farthest, Overlapping

plugin = Plugin(
    name="datasets",
    contract_version=1,
    components=(ChunksSource, Dl3dvSource, Bounded, Farthest, Overlapping),
    examples=(
        ChunksSource.Config(path="chunks"),  # type: ignore[call-arg]
        Dl3dvSource.Config(path="dl3dv"),  # type: ignore[call-arg]
    ),
)

"""MVSplat and DepthSplat for qgs: depth from a plane sweep, one Gaussian per pixel."""

from qgs.contracts import Plugin
from qgs_mvsplat.depthsplat_encoder import DepthSplatEncoder
from qgs_mvsplat.depthsplat_head import WorldHead
from qgs_mvsplat.head import RayHead
from qgs_mvsplat.mvsplat import MVSplatEncoder
from qgs_mvsplat.pixels import OnRays, PixelQueries
from qgs_mvsplat.two_depths import DecayedSupervision, Exchange

plugin = Plugin(
    name="mvsplat",
    contract_version=1,
    components=(
        *(MVSplatEncoder, PixelQueries, RayHead, OnRays),
        *(DepthSplatEncoder, WorldHead, Exchange, DecayedSupervision),
    ),
)

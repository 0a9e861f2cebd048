"""MVSplat and DepthSplat for qgs: depth from a plane sweep, one Gaussian per pixel."""

from qgs.contracts import Plugin
from qgs_mvsplat.depthsplat_encoder import DepthSplatEncoder
from qgs_mvsplat.depthsplat_head import WorldHead
from qgs_mvsplat.head import RayHead
from qgs_mvsplat.mvsplat import MVSplatEncoder
from qgs_mvsplat.pixels import OnRays, PixelQueries
from qgs_mvsplat.two_depths import DecayedSupervision, Exchange
from qgs_mvsplat.weights import MVSPLAT

plugin = Plugin(
    name="mvsplat",
    contract_version=1,
    components=(
        *(MVSplatEncoder, PixelQueries, RayHead, OnRays),
        *(DepthSplatEncoder, WorldHead, Exchange, DecayedSupervision),
    ),
    layouts=(MVSPLAT,),
    examples=(
        MVSplatEncoder.Config(
            near=0.2,
            far=3.0,
            cnn_widths=(8, 8, 8),
            features=8,
            candidates=4,
            cost_width=32,
            cost_levels=1,
            depth_levels=1,
        ),
        RayHead.Config(opacity_exponent=1.0),
        OnRays.Config(measure="depth"),
    ),
    exemptions={
        MVSplatEncoder: {
            "tokens_are_those_of_the_grid": "before training, instance norms over whole maps and "
            "the softmax over depths spread what a pixel shows over its image"
        }
    },
)

"""GS-LRM for qgs: a transformer over the tokens of all photos predicts a Gaussian per pixel."""

from qgs.contracts import Plugin
from qgs_zoo.gslrm.pixels import AlongRays, PixelHead, PixelQueries, Transformer

plugin = Plugin(
    name="gslrm",
    contract_version=1,
    components=(Transformer, PixelQueries, PixelHead, AlongRays),
    examples=(
        Transformer.Config(depth=2, mlp_ratio=2.0),
        PixelHead.Config(gaussians_per_query=6, position_channels=1),
        PixelHead.Config(scale_bias=-4.0, scale_limit=None, opacity_bias=0.0),
        AlongRays.Config(near=0.3, far=3.0),
    ),
)

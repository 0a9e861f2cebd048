"""C3G for qgs: image tokens and queries attend to each other; each query gives one Gaussian."""

from qgs.contracts import Plugin
from qgs_zoo.c3g.joint import C3GHead, JointLayer
from qgs_zoo.c3g.vggt import VggtFeatures

plugin = Plugin(
    name="c3g",
    contract_version=1,
    components=(JointLayer, C3GHead, VggtFeatures),
    examples=(
        JointLayer.Config(mlp_ratio=4.0, norm_eps=1e-3),
        C3GHead.Config(gaussians_per_query=3, scale_unit=0.02),
    ),
)

"""MVSplat and DepthSplat for qgs: a plane sweep finds depths; each pixel gives one Gaussian."""

from qgs.contracts import Plugin
from qgs_zoo.dinov2.vit import VitConfig
from qgs_zoo.mvsplat.depthsplat import DepthSplatEncoder
from qgs_zoo.mvsplat.mvsplat import MVSplatEncoder
from qgs_zoo.mvsplat.pixels import OnRays, PixelQueries, RayHead, WorldHead
from qgs_zoo.mvsplat.two_depths import DecayedSupervision, DepthError, Exchange

_BIASES = "instance norms remove the effect of biases in the CNN, so these biases learn nothing"

plugin = Plugin(
    name="mvsplat",
    contract_version=1,
    components=(
        MVSplatEncoder,
        PixelQueries,
        RayHead,
        OnRays,
        DepthSplatEncoder,
        WorldHead,
        Exchange,
        DecayedSupervision,
        DepthError,
    ),
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
        DepthSplatEncoder.Config(
            near=0.2,
            far=3.0,
            features=32,
            cnn=(4, 8, 8),
            candidates=16,
            vit=VitConfig(width=16, depth=4, heads=2),
            blocks=(0, 1, 2, 3),
            dpt=(8, 8, 8, 16),
            full_features=8,
            regressor=8,
        ),
        RayHead.Config(opacity_exponent=1.0),
        OnRays.Config(measure="depth"),
        WorldHead.Config(scale_max=0.1),
        DecayedSupervision.Config(layers=(1, 2), decay=0.5),
    ),
    exemptions={
        MVSplatEncoder: {
            "compiles": "to save memory, the sweep reads the other photos one after another, so "
            "each number of photos has its own graph",
            "parameters_learn": _BIASES,
            "tokens_are_those_of_the_grid": "before training, instance norms over whole maps and "
            "the softmax over depths spread a change of a pixel over its image",
        },
        DepthSplatEncoder: {
            "parameters_learn": f"{_BIASES}; and where two layers that start at zero follow each "
            "other, the first gets a gradient only after a step of the second"
        },
    },
)

"""The weights of MVSplat: published names, and the recipe that fits a state dict."""

from typing import Any

from qgs.contracts.weights import LayoutError, Rename, Shapes, WeightLayout, size_at
from qgs_zoo.mvsplat.cnn import WIDTHS

_BACKBONE = "encoder.backbone.backbone."
_PREDICTOR = "encoder.depth_predictor."
_PARTS: dict[str, Any] = {
    "queries": {"type": "mvsplat/pixels"},
    "decoder": {
        "depth": 0,
        **dict.fromkeys(("cross_attention", "self_attention", "feed_forward", "refinement")),
    },
    "head": {"type": "mvsplat/gaussians"},
    "centers": {"type": "mvsplat/on_rays"},
    "supervision": {"type": "qgs/layers", "layers": [0]},
}


def unet_levels(shapes: Shapes, name: str) -> int:
    """Levels of the U-Net stored as `name`: each has two blocks on the way up."""
    numbers = {key[len(name) :].split(".")[1] for key in shapes if key.startswith(name + "output")}
    if not numbers or len(numbers) % 2:
        raise LayoutError(f"{name}output_blocks are {len(numbers)}, not two for each level")
    return len(numbers) // 2


def _read(shapes: Shapes) -> dict[str, Any]:
    stages = [size_at(shapes, f"{_BACKBONE}layer{n}.0.conv1.weight", 0) for n in (1, 2, 3)]
    raw = size_at(shapes, _PREDICTOR + "to_gaussians.2.weight", 0)
    encoder = {
        "type": "mvsplat/mvsplat",
        "near": 1.0,
        "far": 100.0,
        "features": size_at(shapes, _BACKBONE + "conv2.weight", 0),
        "candidates": size_at(shapes, _PREDICTOR + "regressor_residual.weight", 0),
        "cost_width": size_at(shapes, _PREDICTOR + "corr_refine_net.0.weight", 0),
        "cost_levels": unet_levels(shapes, _PREDICTOR + "corr_refine_net.3."),
        "depth_width": size_at(shapes, _PREDICTOR + "refine_unet.0.weight", 0),
        "depth_levels": unet_levels(shapes, _PREDICTOR + "refine_unet.3."),
    }
    if tuple(stages) != WIDTHS:
        encoder["cnn_widths"] = stages
    mse = {"type": "qgs/photometric", "mse_weight": 1.0, "ssim_weight": 0.0}
    # The memory has depth and opacity in front of what the release calls a raw Gaussian.
    model = {"width": raw + 2, "heads": 1, "encoder": encoder, **_PARTS}
    views = {"frame": "given", "scale": "constant", "scale_factor": 1.0}
    parts = {"model": model, "views": views, "losses": {"photometric": mse}}
    return {"recipe": 1, "plugins": ["mvsplat"], **parts}


MVSPLAT = WeightLayout(
    name="MVSplat",
    source="donydchen/mvsplat",
    components={
        "encoder": ("mvsplat/mvsplat",),
        "queries": ("mvsplat/pixels",),
        "head": ("mvsplat/gaussians",),
        "centers": ("mvsplat/on_rays",),
    },
    renames=(Rename("encoder.", "encoder."),),
    marks=(_PREDICTOR + "corr_refine_net.0.weight", _PREDICTOR + "to_disparity.2.weight"),
    read=_read,
    undecided=(
        "near and far: 1 and 100, of RealEstate10K and ACID (DTU: 2.125 and 4.525)",
        "bounds of the scales, opacity map: the release's",
        "losses: mean squared error, to which the release adds 0.05 LPIPS (plugin `lpips`)",
        "frame and scale of the world: as given; renderer, training: the framework's defaults",
    ),
)
"""The released MVSplat, in files of Lightning or of a bare state dict."""

"""Published weights of MVSplat and DepthSplat: parameter names, and recipes that fit."""

from qgs.checkpoint.tensors import Shapes
from qgs_research.published.weight_layout import (
    LayoutError,
    Tree,
    layer_count,
    layout,
    size_at,
    whole_ratio,
)

_PREDICTOR = "encoder.depth_predictor."
_VIT = _PREDICTOR + "pretrained."
_UPSAMPLER = "encoder.feature_upsampler."
_HEAD = "encoder.gaussian_head.2.weight"
_HEAD_WIDTH = 64
"""Channels per attention head in every DINOv2 model."""
_BLOCKS = {12: [2, 5, 8, 11], 24: [4, 11, 17, 23]}
"""Indices of the ViT blocks whose outputs are used, by number of blocks."""
_HARMONICS = (4, 9, 16, 25)
"""Number of spherical harmonics per colour channel, for degrees 1 to 4."""
_EMPTY = dict.fromkeys(("cross_attention", "self_attention", "feed_forward", "refinement"))


def _recipe(model: Tree) -> Tree:
    common = {
        "heads": 1,
        "queries": {"type": "mvsplat/pixels"},
        "decoder": {"depth": 0, **_EMPTY},
        "supervision": {"type": "qgs/layers", "layers": [0]},
    }
    photometric = {"type": "qgs/photometric", "mse_weight": 1.0, "ssim_weight": 0.0}
    return {
        "recipe": 1,
        "plugins": ["mvsplat"],
        "model": common | model,
        "views": {"frame": "given", "scale": "constant", "scale_factor": 1.0},
        "losses": {"photometric": photometric},
    }


def _stages(shapes: Shapes, cnn: str) -> list[int]:
    """Return the channels of the three stages of a CNN. cnn: prefix of its parameter names."""
    return [size_at(shapes, f"{cnn}layer{n}.0.conv1.weight") for n in (1, 2, 3)]


def _unet_levels(shapes: Shapes, name: str) -> int:
    """Return the number of levels of a U-Net with two output blocks per level.

    name: prefix of its parameter names. Raises LayoutError for an odd number of blocks.
    """
    blocks = layer_count(shapes, f"{name}output_blocks.")
    if not blocks or blocks % 2:
        raise LayoutError(f"{name}output_blocks has {blocks} blocks, expected two for each level")
    return blocks // 2


def _read_mvsplat(shapes: Shapes) -> Tree:
    backbone = "encoder.backbone.backbone."
    raw = size_at(shapes, _PREDICTOR + "to_gaussians.2.weight")
    encoder = {
        "type": "mvsplat/mvsplat",
        "near": 1.0,
        "far": 100.0,
        "cnn_widths": _stages(shapes, backbone),
        "features": size_at(shapes, backbone + "conv2.weight"),
        "candidates": size_at(shapes, _PREDICTOR + "regressor_residual.weight"),
        "cost_width": size_at(shapes, _PREDICTOR + "corr_refine_net.0.weight"),
        "cost_levels": _unet_levels(shapes, _PREDICTOR + "corr_refine_net.3."),
        "depth_width": size_at(shapes, _PREDICTOR + "refine_unet.0.weight"),
        "depth_levels": _unet_levels(shapes, _PREDICTOR + "refine_unet.3."),
    }
    return _recipe(
        {
            # The memory has depth and opacity before the channels of a raw Gaussian.
            "width": raw + 2,
            "encoder": encoder,
            "head": {"type": "mvsplat/gaussians"},
            "centers": {"type": "mvsplat/on_rays"},
        }
    )


def _read_depthsplat(shapes: Shapes) -> Tree:
    """Return a recipe with the sizes of DepthSplat's weights: releases differ in nothing else.

    Raises LayoutError for a number of scales or blocks that no published model has.
    """
    scales = layer_count(shapes, _PREDICTOR + "regressor.")
    width = size_at(shapes, _VIT + "norm.weight")
    depth = layer_count(shapes, _VIT + "blocks.")
    if scales not in (1, 2) or depth not in _BLOCKS:
        raise LayoutError(f"no published model has {scales} scales and a ViT of {depth} blocks")
    raw = size_at(shapes, _HEAD)
    if raw not in [10 + 3 * harmonics for harmonics in _HARMONICS]:
        raise LayoutError(
            f"{_HEAD} has {raw} channels, expected 10 + 3 (degree + 1)^2 for a degree from 1 to 4"
        )
    dpt = [size_at(shapes, f"{_UPSAMPLER}projects.{n}.weight") for n in range(4)]
    joined = size_at(shapes, _UPSAMPLER + "concat_projects.2.weight", 1)
    two = scales == 2
    encoder = {
        "type": "mvsplat/depthsplat",
        "near": 0.5,
        "far": 100.0,
        "features": size_at(shapes, _PREDICTOR + "backbone.conv2.weight"),
        "cnn": _stages(shapes, _PREDICTOR + "backbone."),
        "candidates": size_at(shapes, _PREDICTOR + "depth_head.0.2.weight"),
        "scales": scales,
        # Other features join at 1/8 only if the CNN reaches that resolution.
        "stride": 4 if joined == dpt[2] else 8,
        "vit": {
            "width": width,
            "depth": depth,
            "heads": whole_ratio(width, _HEAD_WIDTH, "width of the ViT over width of a head"),
        },
        "blocks": _BLOCKS[depth],
        "dpt": dpt,
        "full_features": size_at(shapes, _UPSAMPLER + "scratch.layer1_rn.weight"),
        "regressor": size_at(shapes, "encoder.gaussian_regressor.0.weight"),
        "coarse_depth": two,
    }
    model = {
        # The depths come first.
        "width": raw + 1 + two,
        "encoder": encoder,
        "head": {"type": "mvsplat/depthsplat_gaussians"},
        "centers": {"type": "mvsplat/on_rays", "measure": "depth"},
    }
    if two:
        # One layer for each depth, so that both depths can be supervised.
        model["decoder"] = {"depth": 2, "layer": {"type": "mvsplat/exchange"}, **_EMPTY}
        model["supervision"] = {"type": "mvsplat/decayed", "layers": [1, 2]}
    return _recipe(model)


MVSPLAT = layout("mvsplat", _read_mvsplat)
DEPTHSPLAT = layout("depthsplat", _read_depthsplat)

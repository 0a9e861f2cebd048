"""MVSplat's parameters counted, and its recipe read from names and shapes."""

from pathlib import Path

import pytest
from qgs_mvsplat.weights import MVSPLAT

import qgs
from qgs.contracts import LayoutError

RECIPES = Path(__file__).parents[3] / "recipes"


def conv(inputs: int, outputs: int, side: int = 3, bias: bool = True) -> int:
    return inputs * outputs * side * side + outputs * bias


def residual(inputs: int, outputs: int) -> int:
    skip = conv(inputs, outputs, 1) if inputs != outputs else 0
    return conv(inputs, outputs) + conv(outputs, outputs) + 2 * 2 * outputs + skip


def unet(width: int, levels: int) -> int:
    attention = conv(width, 3 * width, 1) + conv(width, width, 1) + 2 * width
    down = conv(width, width) + levels * residual(width, width)
    up = 2 * levels * residual(2 * width, width)
    between = 2 * (levels - 1) * conv(width, width)
    out = conv(width, width) + 2 * width
    return down + up + between + 2 * residual(width, width) + 3 * attention + out


D, FINE, RAW = 128, 32, 84
CNN = conv(3, 64, 7, bias=False) + conv(128, 128, 1)
CNN += sum(conv(i, o, bias=False) + 3 * conv(o, o, bias=False) for i, o in ((64, 64), (64, 96)))
CNN += conv(96, 128, bias=False) + 3 * conv(128, 128, bias=False)
CNN += conv(64, 96, 1) + conv(96, 128, 1)
TRANSFORMER = 6 * (8 * D * D + 3 * 2 * D + (2 * D) * (8 * D) + (8 * D) * D)
PARTS = {
    "backbone.backbone": (CNN, 1_049_120),
    "backbone.transformer": (TRANSFORMER, 3_150_336),
    "depth_predictor.corr_refine_net": (
        conv(2 * D, D) + 2 * D + unet(D, 3) + conv(D, D),
        5_862_144,
    ),
    "depth_predictor.regressor_residual": (conv(2 * D, D, 1), 32_896),
    "depth_predictor.depth_head_lowres": (conv(D, 2 * D) + conv(2 * D, D), 590_208),
    "depth_predictor.upsampler": (conv(2 * D, D), 295_040),
    "depth_predictor.proj_feature": (conv(D, FINE), 36_896),
    "depth_predictor.refine_unet": (conv(3 + FINE + 2, FINE) + 2 * FINE + unet(FINE, 5), 545_728),
    "depth_predictor.to_gaussians": (
        conv(FINE + 3 + D, 2 * RAW) + conv(2 * RAW, RAW),
        373_716,
    ),
    "depth_predictor.to_disparity": (conv(FINE, 2 * FINE) + conv(2 * FINE, 2), 19_650),
}
"""Parameters by arithmetic, and those of the released code."""


@pytest.mark.parametrize("name", PARTS)
def test_parameters_of_each_part(name: str) -> None:
    model = qgs.compose(RECIPES / "mvsplat/re10k.yaml", device="meta")
    count = sum(x.numel() for x in model.encoder.get_submodule(name).parameters())
    assert count == PARTS[name][0] == PARTS[name][1]


def test_the_published_model() -> None:
    model = qgs.compose(RECIPES / "mvsplat/re10k.yaml", device="meta")
    assert sum(x.numel() for x in model.parameters()) == 11_955_734
    assert len(model.state_dict()) == 471
    shapes = {name: tuple(x.shape) for name, x in model.state_dict().items()}
    read = qgs.compose(MVSPLAT.read(shapes), device="meta").recipe
    assert read is not None
    assert model.recipe is not None
    assert read["model"] | {"renderer": None} == model.recipe["model"] | {"renderer": None}
    with pytest.raises(LayoutError, match="regressor_residual"):
        MVSPLAT.read({k: v for k, v in shapes.items() if "regressor_residual" not in k})

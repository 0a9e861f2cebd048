"""DepthSplat's parameters counted, and its recipes read from names and shapes."""

from pathlib import Path

import pytest
from qgs_mvsplat.depthsplat_weights import DEPTHSPLAT

import qgs
from qgs.contracts import LayoutError

RECIPES = Path(__file__).parents[3] / "recipes/depthsplat"
TOTAL = {
    "small_re10k": 38_346_416,
    "base_re10k": 120_747_896,
    "large_re10k": 354_337_760,
    "base_dl3dv": 120_877_016,
}
"""Parameters of the released code."""
TENSORS = {"small_re10k": 567, "base_re10k": 751, "large_re10k": 919, "base_dl3dv": 751}
DEPTH = "depth_predictor."
PARTS = {
    "small_re10k": {
        "depth_predictor": 35_505_441,
        DEPTH + "backbone": 1_049_120,
        DEPTH + "transformer": 3_150_336,
        DEPTH + "pretrained": 22_056_192,
        DEPTH + "regressor": 6_453_504,
        DEPTH + "regressor_residual": 98_432,
        DEPTH + "depth_head": 590_208,
        DEPTH + "upsampler": 2_107_649,
        "feature_upsampler": 2_707_888,
        "gaussian_regressor": 76_736,
        "gaussian_head": 56_351,
    },
    "base_re10k": {
        "depth_predictor": 111_165_145,
        DEPTH + "mv_pyramid": 69_760,
        DEPTH + "pretrained": 86_579_712,
        DEPTH + "mono_pyramid": 2_507_520,
        DEPTH + "regressor": 9_010_176,
        DEPTH + "regressor_residual": 184_512,
        DEPTH + "depth_head": 700_960,
        DEPTH + "upsampler": 7_913_049,
        "feature_upsampler": 9_420_576,
        "gaussian_regressor": 95_168,
        "gaussian_head": 67_007,
    },
    "large_re10k": {
        "depth_predictor": 337_432_385,
        DEPTH + "pretrained": 304_367_616,
        DEPTH + "mono_pyramid": 4_457_472,
        DEPTH + "regressor": 9_378_816,
        DEPTH + "regressor_residual": 225_472,
        DEPTH + "upsampler": 14_032_833,
        "feature_upsampler": 16_714_112,
        "gaussian_regressor": 113_600,
        "gaussian_head": 77_663,
    },
    "base_dl3dv": {
        "depth_predictor": 111_229_753,
        DEPTH + "upsampler": 7_977_657,
        "feature_upsampler": 9_485_088,
    },
}


def conv(inputs: int, outputs: int, side: int = 3, bias: bool = True) -> int:
    return inputs * outputs * side * side + outputs * bias


def dpt(vit: int, widths: tuple[int, ...], features: int, joined: tuple[int, ...]) -> int:
    """A head without its last convolutions: widths at 1/2 to 1/16, what joins at 1/2 to 1/8."""
    one, two, _, four = widths
    projected = sum(conv(vit, width, 1) for width in widths)
    resized = conv(one, one, 4) + conv(two, two, 2) + conv(four, four)
    concatenated = sum(conv(own + x, own, 1) for own, x in zip(widths, joined, strict=False))
    entered = sum(conv(width, features, bias=False) for width in widths)
    units = 7 * 2 * conv(features, features)  # the coarsest fusion has one, the others two
    return projected + resized + concatenated + entered + units + 4 * conv(features, features, 1)


@pytest.mark.parametrize(
    ("recipe", "vit", "widths", "features", "joined"),
    [
        ("small_re10k", 384, (48, 96, 192, 384), 64, (64 + 96, 128 + 128, 0)),
        ("base_re10k", 768, (96, 192, 384, 768), 96, (64 + 96 + 64, 128 + 128, 0)),
        ("large_re10k", 1024, (128, 256, 512, 1024), 128, (64 + 96 + 64, 128 + 128, 0)),
        ("base_dl3dv", 768, (96, 192, 384, 768), 96, (64, 96 + 64, 128 + 128)),
    ],
)
def test_dpt_heads_by_arithmetic(
    recipe: str, vit: int, widths: tuple[int, ...], features: int, joined: tuple[int, ...]
) -> None:
    assert dpt(vit, widths, features, joined) == PARTS[recipe]["feature_upsampler"]
    # The depth is one channel more, at the resolution of the last sweep.
    level = 0 if recipe in ("base_re10k", "large_re10k") else 1
    with_depth = tuple(x + (n == level) for n, x in enumerate(joined))
    half = features // 2
    last = conv(half, half // 2) + conv(half // 2, 16) + conv(16, 1, 1)
    assert dpt(vit, widths, half, with_depth) + last == PARTS[recipe][DEPTH + "upsampler"]


@pytest.mark.parametrize("name", TOTAL)
def test_the_published_models(name: str) -> None:
    model = qgs.compose(RECIPES / f"{name}.yaml", device="meta")
    state = model.state_dict()
    assert sum(x.numel() for x in state.values()) == TOTAL[name]
    assert len(state) == TENSORS[name]
    for part, count in PARTS[name].items():
        found = model.encoder.network.get_submodule(part)
        assert sum(x.numel() for x in found.parameters()) == count, part
    shapes = {str(DEPTHSPLAT.published_name(n)): tuple(x.shape) for n, x in state.items()}
    read = qgs.compose(DEPTHSPLAT.read(shapes), device="meta").recipe
    assert read is not None
    assert model.recipe is not None
    left = {"renderer": None}
    wanted = model.recipe["model"]
    if name == "base_dl3dv":  # the file does not tell the data set
        wanted = {**wanted, "encoder": {**wanted["encoder"], "far": 100.0}}
    assert read["model"] | left == wanted | left
    for missing in ("pretrained.norm.weight", "gaussian_regressor.0.weight"):
        with pytest.raises(LayoutError):
            DEPTHSPLAT.read({k: x for k, x in shapes.items() if not k.endswith(missing)})

"""Parameters counted part by part, and recipes read from names and shapes."""

import pytest
from qgs_zoo.mvsplat.weights import DEPTHSPLAT, MVSPLAT

from qgs.contracts import LayoutError
from qgs.recipe import resolve

PUBLISHED = {
    "mvsplat/re10k": """
        tensors                                      471
        all                                   11_955_734
        backbone.backbone                      1_049_120
        backbone.transformer                   3_150_336
        depth_predictor.corr_refine_net        5_862_144
        depth_predictor.regressor_residual        32_896
        depth_predictor.depth_head_lowres        590_208
        depth_predictor.upsampler                295_040
        depth_predictor.proj_feature              36_896
        depth_predictor.refine_unet              545_728
        depth_predictor.to_gaussians             373_716
        depth_predictor.to_disparity              19_650
    """,
    "depthsplat/small_re10k": """
        tensors                                      567
        all                                   38_346_416
        depth_predictor                       35_505_441
        depth_predictor.backbone               1_049_120
        depth_predictor.transformer            3_150_336
        depth_predictor.pretrained            22_056_192
        depth_predictor.regressor              6_453_504
        depth_predictor.regressor_residual        98_432
        depth_predictor.depth_head               590_208
        depth_predictor.upsampler              2_107_649
        feature_upsampler                      2_707_888
        gaussian_regressor                        76_736
        gaussian_head                             56_351
    """,
    "depthsplat/base_re10k": """
        tensors                                      751
        all                                  120_747_896
        depth_predictor                      111_165_145
        depth_predictor.mv_pyramid                69_760
        depth_predictor.pretrained            86_579_712
        depth_predictor.mono_pyramid           2_507_520
        depth_predictor.regressor              9_010_176
        depth_predictor.regressor_residual       184_512
        depth_predictor.depth_head               700_960
        depth_predictor.upsampler              7_913_049
        feature_upsampler                      9_420_576
        gaussian_regressor                        95_168
        gaussian_head                             67_007
    """,
    "depthsplat/large_re10k": """
        tensors                                      919
        all                                  354_337_760
        depth_predictor                      337_432_385
        depth_predictor.pretrained           304_367_616
        depth_predictor.mono_pyramid           4_457_472
        depth_predictor.regressor              9_378_816
        depth_predictor.regressor_residual       225_472
        depth_predictor.upsampler             14_032_833
        feature_upsampler                     16_714_112
        gaussian_regressor                       113_600
        gaussian_head                             77_663
    """,
    "depthsplat/base_dl3dv": """
        tensors                                      751
        all                                  120_877_016
        depth_predictor                      111_229_753
        depth_predictor.upsampler              7_977_657
        feature_upsampler                      9_485_088
    """,
}
"""Tensors of the released models, parameters, and those of parts."""


MISSING = {
    "MVSplat": ("regressor_residual.weight",),
    "DepthSplat": ("pretrained.norm.weight", "gaussian_regressor.0.weight"),
}
"""Ends of names without which a file is refused."""


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_published_models(name):
    recipe = resolve(f"{name}.yaml")
    model = recipe.build_model("meta")
    state = model.state_dict()
    sizes = dict(line.split() for line in PUBLISHED[name].strip().splitlines())
    assert len(state) == int(sizes.pop("tensors"))
    assert sum(x.numel() for x in state.values()) == int(sizes.pop("all"))
    released = getattr(model.encoder, "network", model.encoder)
    for part, count in sizes.items():
        found = sum(x.numel() for x in released.get_submodule(part).parameters())
        assert found == int(count), part
    layout = MVSPLAT if name.startswith("mvsplat") else DEPTHSPLAT
    shapes = {layout.published_name(n): tuple(x.shape) for n, x in state.items()}
    wanted = dict(recipe.tree["model"])
    if name == "depthsplat/base_dl3dv":  # the file does not tell the data set
        wanted["encoder"] = {**wanted["encoder"], "far": 100.0}
    read = resolve(layout.read(shapes)).tree["model"]
    assert read | {"renderer": None} == wanted | {"renderer": None}
    for end in MISSING[layout.name]:
        with pytest.raises(LayoutError, match=end.partition(".")[0]):
            layout.read({n: shape for n, shape in shapes.items() if not n.endswith(end)})

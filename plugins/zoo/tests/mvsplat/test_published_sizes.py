"""Parameters counted part by part, recipes read from shapes, and DepthSplat's two depths."""

from dataclasses import replace

import pytest
import torch
from qgs_dev import CHECKS, cases_of
from qgs_dev.inputs import inputs_of
from qgs_research.published.mvsplat import DEPTHSPLAT, MVSPLAT
from qgs_research.published.weight_layout import LayoutError
from qgs_zoo.mvsplat import DecayedSupervision, DepthError, DepthSplatEncoder
from tables import rows

from qgs.contracts import MetricInput
from qgs.recipe import resolve
from qgs.recipe.registry import load_plugin

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
    sizes = dict(rows(PUBLISHED[name], None))
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


CHECKED = ("inputs_are_not_changed", "zeros_stay_finite", "batch_independence",
           "geometry_is_float32_under_autocast")  # fmt: skip


def depthsplat(scales):
    """The example of the plugin with so many scales; of two, each has a depth."""
    cases = cases_of(load_plugin("mvsplat"))
    example = next(case for case in cases if case.component is DepthSplatEncoder)
    sizes = {"features": 32 * scales, "scales": scales, "coarse_depth": scales > 1}
    return replace(example, config=example.config.model_copy(update=sizes))


def test_two_scales_keep_the_contract():
    """No check can follow the gradients: the second sweep takes none of the first."""
    case = depthsplat(scales=2)
    for name in CHECKED:
        CHECKS[name].function(case)


def test_the_first_sweep_learns_from_its_own_depth_alone():
    case = depthsplat(scales=2)
    encoder = case.lively()
    numbers = encoder(*inputs_of(case).values()).features
    heads = [head[2].weight for head in encoder.network.depth_predictor.depth_head]
    for channel, learns in ((-1, [True, False]), (0, [False, True])):
        found = torch.autograd.grad(numbers[..., channel].sum(), heads, retain_graph=True)
        assert [bool(x.any()) for x in found] == learns


def test_later_depths_weigh_more():
    weights = DecayedSupervision(DecayedSupervision.Config(layers=(1, 2))).weights()
    assert weights == pytest.approx({1: 0.9 / 1.9, 2: 1 / 1.9})


def test_errors_of_depth_count_where_the_truth_is_known():
    views = inputs_of(depthsplat(scales=1))["views"]
    true = torch.tensor([2.0, 4, 0, 1]).view(1, 1, 1, 2, 2)
    rendered = torch.tensor([3.0, 3, 7, 0]).view(1, 1, 1, 2, 2)
    metric = DepthError(DepthError.Config())
    found = metric(MetricInput(views.images, views, depth=rendered, true_depth=true))
    assert found.tolist() == [0.5, 0.25, 1.0]

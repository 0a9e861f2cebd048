"""DepthSplat's two depths: both are supervised, layers exchange them, errors count where known."""

from dataclasses import replace

import pytest
import torch
from qgs_dev import CHECKS, cases_of, run_check
from qgs_dev.inputs import inputs_of
from qgs_zoo.mvsplat import DecayedSupervision, DepthError, DepthSplatEncoder, Exchange
from small_parts import made

from qgs.contracts import LayerParts, MetricInput, ModelDims
from qgs.recipe.registry import load_plugin
from qgs.types import QueryState

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
    results = [run_check(CHECKS[name], case) for name in CHECKED]
    assert [result.message for result in results if result.verdict != "passed"] == []


def test_the_first_sweep_learns_from_its_own_depth_alone():
    case = depthsplat(scales=2)
    encoder = case.lively()
    numbers = encoder(*inputs_of(case).values()).features
    heads = [head[2].weight for head in encoder.network.depth_predictor.depth_head]
    for channel, learns in ((-1, [True, False]), (0, [False, True])):
        found = torch.autograd.grad(numbers[..., channel].sum(), heads, retain_graph=True)
        assert [bool(x.any()) for x in found] == learns


def test_layers_exchange_the_depths():
    features = torch.arange(8.0).view(1, 2, 4)
    layer = made(Exchange, LayerParts(ModelDims(4, 1, 2), {}, 1.0))
    once = layer(QueryState(features), None)[0]
    assert once.features[0].tolist() == [[3, 1, 2, 0], [7, 5, 6, 4]]
    assert torch.equal(layer(once, None)[0].features, features)


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

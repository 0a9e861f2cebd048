"""Components of DepthSplat keep their contracts; both depths of two scales are supervised."""

from dataclasses import replace

import pytest
import torch
from qgs_mvsplat import DecayedSupervision, DepthError, DepthSplatEncoder, Exchange, WorldHead
from qgs_plugintools import Case, cases_of, checks_for, parametrize_with_checks, run_check
from qgs_plugintools.inputs import inputs_of
from qgs_plugintools.plugins import exemptions_of

from qgs.composer.registry import load_plugin
from qgs.contracts import LayerParts, MetricInput, ModelDims
from qgs.types import ImageMemory, QueryState

OWN = (DepthSplatEncoder, WorldHead, Exchange, DecayedSupervision, DepthError)
PLUGIN = load_plugin("mvsplat")
ALL = cases_of(PLUGIN)
KNOWN = dict(zip([case.label for case in ALL], exemptions_of(PLUGIN, ALL), strict=True))
CASES = [case for case in ALL if issubclass(case.component, OWN)]

ONE = next(case for case in CASES if case.component is DepthSplatEncoder)
SEVERAL = {"features": 64, "scales": 2, "coarse_depth": True}
TWO: Case = replace(ONE, config=ONE.config.model_copy(update=SEVERAL))
STOPPED = ("gradients_match_differences", "tokens_are_those_of_the_grid", *KNOWN[ONE.label])
"""Of two scales no check can follow the gradients: the second sweep takes none of the first. Tokens
are placed by the code of one scale."""


@parametrize_with_checks(CASES, expected_failures=lambda case: KNOWN[case.label], tiers=["core"])
def test_contract(check) -> None:
    check()


@pytest.mark.parametrize(
    "check", [x for x in checks_for(TWO, ["core"]) if x.name not in STOPPED], ids=lambda x: x.name
)
def test_contract_of_two_scales(check) -> None:
    outcome = run_check(check, TWO)
    assert outcome.verdict != "failed", outcome.message


def test_the_first_sweep_learns_from_its_own_depth_alone() -> None:
    encoder = TWO.lively()
    numbers = encoder(*inputs_of(TWO).values()).features
    heads = [head[2].weight for head in encoder.network.depth_predictor.depth_head]
    coarse = torch.autograd.grad(numbers[..., -1].sum(), heads, retain_graph=True)
    final = torch.autograd.grad(numbers[..., 0].sum(), heads)
    assert [bool(x.any()) for x in coarse] == [True, False]
    assert [bool(x.any()) for x in final] == [False, True]


def test_layers_exchange_the_depths() -> None:
    features = torch.arange(8.0).view(1, 2, 4)
    state, memory = QueryState(features), ImageMemory(features)
    layer = Exchange(Exchange.Config(), LayerParts(ModelDims(4, 1, 2), {}, 1.0))
    once = layer(state, memory)[0]
    assert once.features[0].tolist() == [[3, 1, 2, 0], [7, 5, 6, 4]]
    assert torch.equal(layer(once, memory)[0].features, features)


def test_later_depths_weigh_more() -> None:
    weights = DecayedSupervision(DecayedSupervision.Config(layers=(1, 2))).weights()
    assert weights == pytest.approx({1: 0.9 / 1.9, 2: 1 / 1.9})


def test_errors_of_depth_count_where_the_truth_is_known() -> None:
    views = inputs_of(ONE)["views"]
    true = torch.tensor([2.0, 4, 0, 1]).view(1, 1, 1, 2, 2)
    rendered = torch.tensor([3.0, 3, 7, 0]).view(1, 1, 1, 2, 2)
    metric = DepthError(DepthError.Config())
    found = metric(MetricInput(views.images, views, depth=rendered, true_depth=true))
    assert found.tolist() == [0.5, 0.25, 1.0]

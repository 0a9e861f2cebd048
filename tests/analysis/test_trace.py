import pytest
import torch

import qgs
from qgs.types import Cameras, Views


def hook_count(model) -> int:
    modules = list(model.modules())
    return sum(len(m._forward_hooks) + len(m._forward_pre_hooks) for m in modules)


def test_records_chosen_layers_and_queries(model, views):
    with qgs.trace(model, layers=[1, 3], queries=[7, 2]) as trace:
        prediction = model(views, layers=[1, 2])
    assert sorted(trace.layers) == [1, 3]
    assert trace.grid == (2, 4, 4)
    after = trace.layers[1].after
    torch.testing.assert_close(after.features, prediction.layers[1].state.features[:, [7, 2]])
    before = trace.layers[3].before
    torch.testing.assert_close(before.features, prediction.layers[2].state.features[:, [7, 2]])


def test_attention_weights_are_the_ones_that_ran(model, views):
    with qgs.trace(model, layers=[2], queries=[5]) as trace:
        model(views)
    layer = trace.layers[2]
    assert layer.cross_attention.weights.shape == (1, 2, 1, 32)
    assert layer.self_attention.weights.shape == (1, 2, 1, model.queries.count)
    assert layer.cross_attention.geometry is None
    read = layer.cross_attention.weights[0, :, 0]
    torch.testing.assert_close(read.sum(-1), torch.ones(2))
    assert not layer.absent


def test_a_traced_pass_predicts_the_same(model, views):
    plain = model(views)
    with qgs.trace(model):
        traced = model(views)
    assert torch.equal(plain.gaussians.means, traced.gaussians.means)


def test_hooks_go_away_even_on_errors(model, views):
    images = torch.zeros(1, 2, 3, 36, 36)
    odd = Views(images, Cameras(views.cameras.c2w, views.cameras.intrinsics, (36, 36)))
    with pytest.raises(ValueError, match="patches"), qgs.trace(model):
        model(odd)
    assert hook_count(model) == 0


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"layers": [0, 4]}, r"layers \[0, 4\] do not exist.*1\.\.3"),
        ({"queries": [12]}, r"queries \[12\] do not exist.*0\.\.11"),
    ],
)
def test_unknown_layers_and_queries_are_refused(model, wanted, message):
    with pytest.raises(ValueError, match=message), qgs.trace(model, **wanted):
        pass
    assert hook_count(model) == 0

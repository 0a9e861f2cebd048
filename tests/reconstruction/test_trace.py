import pytest
import torch
from tables import must_refuse
from torch.testing import assert_close

import qgs


def test_chosen_layers_and_queries_are_recorded_of_a_pass_that_predicts_the_same(model, views):
    plain = model(views)
    with qgs.trace(model, layers=[1, 3], queries=[7, 2]) as trace:
        prediction = model(views, layers=[1, 2])
    assert torch.equal(plain.gaussians.means, prediction.gaussians.means)
    assert sorted(trace.layers) == [1, 3]
    assert trace.grid == (2, 4, 4)
    first, last = trace.layers.values()
    for state, number in ((first.after, 1), (last.before, 2)):
        assert_close(state.features, prediction.layers[number].state.features[:, [7, 2]])
    read = last.cross_attention.weights
    assert read.shape == (1, 2, 2, 32)
    assert_close(read.sum(-1), torch.ones(1, 2, 2))
    assert last.self_attention.weights.shape == (1, 2, 2, 12)
    assert last.cross_attention.geometry is None


def test_hooks_go_away_even_on_errors(model):
    with pytest.raises(AttributeError), qgs.trace(model):
        model(None)
    must_refuse(r"layers \[0, 4\] do not exist.*1\.\.3", qgs.trace(model, layers=[0, 4]).__enter__)
    must_refuse(r"queries \[12\] do not exist.*0\.\.11", qgs.trace(model, queries=[12]).__enter__)
    assert not any(m._forward_hooks or m._forward_pre_hooks for m in model.modules())

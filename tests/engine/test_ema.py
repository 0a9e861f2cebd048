"""The moving average of the weights."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from training_runs import Tiny

from qgs.engine.optimizer import MovingAverage
from qgs.io.checkpoint import unique_tensors


class Small(nn.Module):
    """A weight, one that is shared, and a counter."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Linear(3, 2, bias=False)
        self.second = self.first
        self.register_buffer("seen", torch.zeros((), dtype=torch.long))


def test_it_is_the_weighted_mean_of_all_weights_so_far() -> None:
    model = Small()
    average = MovingAverage(model, 0.9)
    history = [model.first.weight.detach().clone()]
    for step in range(5):
        with torch.no_grad():
            model.first.weight.copy_(torch.randn(2, 3))
            model.seen.add_(1)
        history.append(model.first.weight.detach().clone())
        average.update()
        assert int(average.state()["seen"]) == step + 1
    weights = [0.9**5, *(0.1 * 0.9 ** (4 - k) for k in range(5))]
    assert sum(weights) == pytest.approx(1)
    expected = sum(w * value for w, value in zip(weights, history, strict=True))
    assert set(average.state()) == {"first.weight", "seen"}, "shared weights once"
    torch.testing.assert_close(average.state()["first.weight"], expected)


def test_it_is_applied_for_a_while_only() -> None:
    model = Small()
    average = MovingAverage(model, 0.5)
    before = model.first.weight.detach().clone()
    with torch.no_grad():
        model.first.weight.add_(1.0)
    average.update()
    present = model.first.weight.detach().clone()
    with average.applied():
        torch.testing.assert_close(model.first.weight, before + 0.5)
    assert torch.equal(model.first.weight, present)


def test_the_average_of_half_precision_weights_is_float32() -> None:
    model = Small().to(torch.bfloat16)
    average = MovingAverage(model, 0.999)
    with torch.no_grad():
        model.first.weight.add_(1.0)
    average.update()
    assert average.state()["first.weight"].dtype == torch.float32
    assert not torch.equal(
        average.state()["first.weight"], MovingAverage(model, 0.9).state()["first.weight"]
    )


def test_a_restored_average_goes_on_alike(tiny: Tiny) -> None:
    model = tiny("locus").build_model()
    average, restored = MovingAverage(model, 0.9), MovingAverage(model, 0.9)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1)
    average.update()
    restored.load_state(average.state())
    average.update()
    restored.update()
    assert average.state().keys() == unique_tensors(model).keys()
    assert all(torch.equal(t, average.state()[name]) for name, t in restored.state().items())

"""The objective: which views each pass sees, what is compared, who gets the gradient."""

from itertools import pairwise

import pytest
import torch
from globalsplat_inputs import views
from qgs_globalsplat.objective import TwoPasses, disagreement, subset
from torch import Tensor, nn

from qgs.contracts import Outcome
from qgs.types import Rendering, Views


@pytest.mark.parametrize("count", range(3, 13))
def test_passes_share_the_ends_and_part_the_rest(count: int) -> None:
    one, other = (subset(count, part) for part in (0, 1))
    assert set(one) & set(other) == {0, count - 1}
    assert set(one) | set(other) == set(range(count))
    assert all(a < b for part in (one, other) for a, b in pairwise(part))
    assert 0 <= len(one) - len(other) <= 1


class Lent:
    """Passes of a model whose alpha and depth are the mean of what it sees, times `gain`."""

    def __init__(self) -> None:
        self.gain = nn.Parameter(torch.tensor(2.0))
        self.seen: list[Tensor] = []

    def predict(self, inputs: Views):
        self.seen.append(inputs.images)
        return _Prediction(self.gain * inputs.images.mean())

    def judge(self, prediction, targets: Views, inputs: Views) -> Outcome:
        assert torch.equal(inputs.images, self.seen[-1])
        total = prediction.gaussians**2
        signs = {n: torch.tensor(0.5) for n in ("psnr", "alpha", "deviation")}
        return Outcome(total, {"error": total.detach()}, signs)

    def render(self, gaussians, cameras) -> Rendering:
        shape = (2, 2, 1, 4, 4)
        return Rendering(
            torch.zeros(2, 2, 3, 4, 4), gaussians.expand(shape), 3 * gaussians.expand(shape)
        )


class _Prediction:
    def __init__(self, gaussians: Tensor) -> None:
        self.gaussians = gaussians


def test_both_are_judged_and_compared() -> None:
    inputs, lent = views(5), Lent()
    config = TwoPasses.Config(alpha_weight=0.1, depth_weight=0.2)
    outcome = TwoPasses(config).forward(inputs, views(2), lent)
    assert [x.shape[1] for x in lent.seen] == [4, 3]
    a, b = (2 * x.mean() for x in lent.seen)
    apart = (a - b).abs()
    torch.testing.assert_close(outcome.terms["error"], (a**2 + b**2) / 2)
    torch.testing.assert_close(outcome.terms["alpha_consistency"], 0.1 * apart)
    torch.testing.assert_close(outcome.terms["depth_consistency"], 0.2 * 3 * apart)
    torch.testing.assert_close(outcome.total.detach(), sum(outcome.terms.values()))
    assert outcome.total.requires_grad


def test_each_is_pulled_to_the_other_that_stands_still() -> None:
    one, other = (torch.tensor([x], requires_grad=True) for x in (1.0, 4.0))
    apart = disagreement(one, other)
    assert apart == 3
    apart.backward()
    assert one.grad == -0.5
    assert other.grad == 0.5


def test_two_views_are_too_few_and_it_says_so() -> None:
    with pytest.raises(ValueError, match=r"at least 3 input views, got 2: .* raise views\.inputs"):
        TwoPasses(TwoPasses.Config()).forward(views(2), views(2), Lent())


def test_weights_are_the_published_ones() -> None:
    assert TwoPasses.Config().model_dump() == {"alpha_weight": 1e-3, "depth_weight": 1e-2}

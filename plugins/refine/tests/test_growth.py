"""What Gaussians share when they are split, against integrals and sums computed here."""

import math

import pytest
import torch
from qgs_refine.growth import shared

POSITIONS = torch.linspace(-12, 12, 20001, dtype=torch.float64)


def through(opacity: float, scale: float, number: int) -> float:
    """What a line of pixels gets through `number` equal Gaussians one behind the other."""
    alpha = opacity * torch.exp(-POSITIONS.square() / (2 * scale**2))
    return float(torch.trapezoid(1 - (1 - alpha) ** number, POSITIONS))


@pytest.mark.parametrize("number", [1, 2, 3, 10, 51])
@pytest.mark.parametrize("opacity", [0.01, 0.5, 0.99])
def test_the_sum_of_the_shares_is_the_whole(number: int, opacity: float) -> None:
    new, factor = shared(torch.tensor([opacity], dtype=torch.float64), torch.tensor([number]))
    assert 1 - (1 - float(new)) ** number == pytest.approx(opacity)
    assert through(float(new), float(factor), number) == pytest.approx(through(opacity, 1, 1))


def test_the_papers_double_sum() -> None:
    opacities, shares = torch.rand(20, dtype=torch.float64), torch.randint(1, 9, (20,))
    new, factor = shared(opacities, shares)
    for old, number, opacity, scale in zip(opacities, shares, new, factor, strict=True):
        total = sum(
            math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * float(opacity) ** (k + 1)
            for i in range(1, int(number) + 1)
            for k in range(i)
        )
        assert float(scale) == pytest.approx(float(old) / total)


def test_more_shares_than_the_table_has_are_counted_as_its_last() -> None:
    at_last, beyond = (shared(torch.tensor([0.7]), torch.tensor([n])) for n in (51, 400))
    assert torch.equal(at_last[0], beyond[0])
    assert torch.equal(at_last[1], beyond[1])

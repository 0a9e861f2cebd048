"""What Gaussians share when they are split, against integrals computed here."""

import torch
from qgs_photos.refine.growth import shared
from torch.testing import assert_close

POSITIONS = torch.linspace(-12, 12, 20001, dtype=torch.float64)


def through(opacity, scale, number):
    """What a line of pixels gets through `number` equal Gaussians one behind the other."""
    exponents = POSITIONS.square() / (2 * scale[:, None] ** 2)
    alpha = opacity[:, None] * torch.exp(-exponents)
    return torch.trapezoid(1 - (1 - alpha) ** number[:, None], POSITIONS)


def test_the_sum_of_the_shares_is_the_whole():
    numbers = torch.tensor([1.0, 2, 3, 10, 51])
    opacities, numbers = torch.cartesian_prod(torch.tensor([0.01, 0.5, 0.99]), numbers).T.double()
    new, factor = shared(opacities, numbers.long())
    assert_close(1 - (1 - new) ** numbers, opacities)
    one = torch.ones_like(numbers)
    assert_close(through(new, factor, numbers), through(opacities, one, one))


def test_more_shares_than_the_table_has_are_counted_as_its_last():
    new, factor = shared(torch.tensor([0.7, 0.7]), torch.tensor([51, 400]))
    assert new[0] == new[1]
    assert factor[0] == factor[1]

"""On "meta", what is made from shapes alone is what torch makes there itself."""

from contextlib import nullcontext

import pytest
import torch
from torch import ones, tensor

from qgs.composer.build import ShapesAlone

EXPRESSIONS = (
    lambda: torch.cat([ones(2, 3), ones(2, 4)], 0),
    lambda: torch.cat([ones(2, 3), ones(2, 4)], 1),
    lambda: torch.cat([ones(2, 3), ones(2, 3)], 2),
    lambda: torch.cat([ones(2, dtype=torch.int64), ones(2)], 0),
    lambda: torch.cat([ones(0), ones(2, 3)], 0),
    lambda: torch.cat([], 0),
    lambda: ones(2, requires_grad=True) * 2,
    lambda: ones(2, 1) * ones(3) + 1,
    lambda: ones(2) * ones(3),
    lambda: ones(2, dtype=torch.float64) * ones(2),
    lambda: ones(2, dtype=torch.int64) * 0.5,
    lambda: ones(2) - True,
    lambda: ones(2, 3).t() / 2,
    lambda: 2 / ones(2) + 1 - 2 ** ones(2) ** 2,
    lambda: ones(2) * tensor(3.0, device="cpu"),
    lambda: torch.randn(2, 3),
    lambda: torch.randn(2, requires_grad=True),
    lambda: [float(x) for x in torch.arange(4, device="cpu") * 0.5],
    lambda: float((torch.from_numpy(torch.arange(3, device="cpu").numpy()) / 2).sum()),
    lambda: torch.randn(4, device="cpu").tolist(),
)


def made(expression, mode):
    torch.manual_seed(0)
    with torch.device("meta"), mode:
        try:
            x = expression()
        except Exception as error:
            return type(error), str(error)
    return (x.shape, x.stride(), x.dtype, x.device, x.requires_grad) if torch.is_tensor(x) else x


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_it_is_what_torch_makes(expression):
    assert made(expression, ShapesAlone()) == made(expression, nullcontext())

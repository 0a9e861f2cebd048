"""Where the numbers of an input lie in memory makes no difference."""

from __future__ import annotations

from torch import Tensor

from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import MODULES, check
from qgs.testing.subjects import inputs_of
from qgs.testing.trees import distance, mapped

RTOL, ATOL = 1e-3, 1e-4
"""How far results may differ, since other layouts are summed up in another order."""


@check(MODULES - {"queries"})
def check_layout_makes_no_difference(case: Case) -> None:
    """Inputs that are not contiguous, such as expanded or sliced ones, give the same results."""
    module, inputs = case.lively(), inputs_of(case)
    spread = mapped(inputs, lambda _, tensor: _spread(tensor))
    found = distance(module(*inputs.values()), module(*spread.values()), RTOL, ATOL)
    expect(not found, f"with inputs that are not contiguous, {found}")


def _spread(tensor: Tensor) -> Tensor:
    """The same numbers, with gaps in memory along every dimension."""
    room = tensor.new_zeros([size + 1 for size in tensor.shape])
    return room[tuple(slice(size) for size in tensor.shape)].copy_(tensor)

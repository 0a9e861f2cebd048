"""What all other checks take for granted: a component can be built and called."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from qgs.testing.case import Case
from qgs.testing.faults import CannotCheck, expect
from qgs.testing.registry import ALL_SLOTS, MODULES, check
from qgs.testing.subjects import inputs_of
from qgs.types import GaussianAttributes, ImageMemory, QueryState, Rendering

OUTPUTS: Mapping[str, type] = {
    "encoder": ImageMemory,
    "queries": QueryState,
    "cross_attention": Tensor,
    "self_attention": Tensor,
    "feed_forward": Tensor,
    "refinement": QueryState,
    "head": GaussianAttributes,
    "centers": Tensor,
    "renderer": Rendering,
    "losses": Mapping,
}
"""What a forward pass gives."""


@check(ALL_SLOTS)
def check_builds(case: Case) -> None:
    """A component can be built from its options, and where it has parameters from its sizes."""
    try:
        case.build()
    except FileNotFoundError as error:
        if case.slot != "data":
            raise
        raise CannotCheck(f"the data of this case is not here: {error}") from error


@check(MODULES)
def check_runs(case: Case) -> None:
    """A forward pass on ordinary inputs gives what the contract of the slot says that it gives."""
    output = case.lively()(*inputs_of(case).values())
    kind = OUTPUTS[case.slot]
    given = type(output).__name__
    expect(isinstance(output, kind), f"it gives a {given}, not a {kind.__name__}")
    if isinstance(output, Mapping):
        odd = [name for name, term in output.items() if not isinstance(term, Tensor)]
        expect(not odd, f"{', '.join(map(str, odd))} is no tensor")

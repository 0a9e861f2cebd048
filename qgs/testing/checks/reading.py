"""What is read is what is declared, proved by inputs that note who looks at them."""

from __future__ import annotations

import torch
from torch import Tensor

from qgs.composer.flow import variants
from qgs.contracts import FieldSpec, Loss
from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.modes import each_mode
from qgs.testing.recording import Reads, recorded
from qgs.testing.registry import STATEFUL, check
from qgs.testing.subjects import Maker, Sizes, inputs_of

UNKNOWN = FieldSpec((3,))
"""What a field is taken for of which the component declares nothing with any options."""


@check(STATEFUL)
def check_reads_within_requires(case: Case) -> None:
    """Only fields in `requires` are asked for, of the state and of the image memory.

    Looking whether a field is there is asking for it. The other fields are passed on with
    `QueryState.replace`. A loss looks at no rendering if it declares that it needs none.
    """
    reads, failure = _reads(case)
    beyond = sorted((reads.asked | fields_of(reads.numbers)) - set(_required(case)))
    expect(not beyond, f"it reads {', '.join(beyond)}, which it does not require")
    expect(
        not reads.all_asked,
        "it goes through all fields of the state; read those in `requires` by their names, and "
        "pass the others on with `state.replace`",
    )
    component = case.component
    if issubclass(component, Loss) and component.renderings == "none":
        seen = sorted(name for name in reads.numbers if name.startswith("rendering."))
        expect(not seen, f"it reads {', '.join(seen)}, although `renderings` is none")
    if failure is not None:
        raise failure


@check(STATEFUL)
def check_requires_are_read(case: Case) -> None:
    """Every field in `requires` is read: else recipes that lack it are refused for nothing."""
    reads, failure = _reads(case)
    if failure is not None:
        raise failure
    idle = sorted(set(_required(case)) - fields_of(reads.numbers) - reads.numbers)
    expect(not idle, f"it requires {', '.join(idle)}, which it does not read")


def fields_of(names: set[str]) -> set[str]:
    """The fields of the state and the tensors of the image memory among tensors of the inputs."""
    of_state = {field for _, _, field in (name.partition(".fields.") for name in names) if field}
    return of_state | {name for name in names if name.startswith("memory.")}


def _required(case: Case) -> dict[str, FieldSpec]:
    return dict(case.component.requires(case.config))


def _reads(case: Case) -> tuple[Reads, Exception | None]:
    """What forward passes look at, in evaluation and in training, and how one failed.

    It may have failed for what it found where it had nothing to look for.
    """
    maker = Maker(case, Sizes(), torch.Generator().manual_seed(1))
    known = _fields_of_other_options(case)

    def absent(name: str) -> Tensor:
        return maker.field(name, known.get(name, UNKNOWN))

    module = case.lively()
    inputs, reads = recorded(inputs_of(case), absent)
    try:
        for _ in each_mode(module):
            module(*inputs.values())
    except Exception as error:
        return reads, error
    return reads, None


def _fields_of_other_options(case: Case) -> dict[str, FieldSpec]:
    """Fields that the component's class requires or provides with any other options."""
    return {
        name: spec
        for _, _, config in variants(case.config)
        for declare in (case.component.requires, case.component.provides)
        for name, spec in declare(config).items()
    }

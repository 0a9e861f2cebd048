"""What is read is what is declared, proved by tensors that note when they are read."""

from __future__ import annotations

import torch

from qgs.composer.providers import variants
from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.recording import recorded
from qgs.testing.registry import STATEFUL, check
from qgs.testing.subjects import inputs_of
from qgs.types import QueryState

UNRELATED: tuple[str, ...] = ("unrelated.place", "unrelated.weight")


@check(STATEFUL)
def check_reads_within_requires(case: Case) -> None:
    """Only fields in `requires` are read, of the state and of the image memory."""
    read = _fields_read(case, _temptations(case))
    beyond = sorted(read - set(case.component.requires(case.config)))
    expect(not beyond, f"it reads {', '.join(beyond)}, which it does not require")


@check(STATEFUL)
def check_requires_are_read(case: Case) -> None:
    """Every field in `requires` is read: else recipes that lack it are refused for nothing."""
    required = set(case.component.requires(case.config))
    idle = sorted(required - _fields_read(case, {}))
    expect(not idle, f"it requires {', '.join(idle)}, which it does not read")


def _temptations(case: Case) -> dict[str, int]:
    """Fields, and their last dimension, that a component may look for unasked.

    Those that its class requires or provides with any other options, and a few of no meaning.
    """
    fields: dict[str, int] = dict.fromkeys(UNRELATED, 3)
    for config in (case.config, *(config for *_, config in variants(case.config))):
        for declare in (case.component.requires, case.component.provides):
            for name, spec in declare(config).items():
                size = spec.shape[-1] if spec.shape else 1
                fields[name] = size if isinstance(size, int) else 1
    return fields


def _fields_read(case: Case, others: dict[str, int]) -> set[str]:
    inputs = inputs_of(case)

    def tempting(state: QueryState) -> QueryState:
        sizes = {n: s for n, s in others.items() if n not in state.fields and "memory." not in n}
        shape = state.features.shape[:2]
        return state.replace(fields={n: torch.ones(*shape, size) for n, size in sizes.items()})

    if "state" in inputs:
        inputs["state"] = tempting(inputs["state"])
    module = case.lively()
    copy, read = recorded(inputs)
    module(*copy.values())
    found = set()
    for name in read:
        owner, _, field = name.partition(".fields.")
        if field:
            found.add(field)
        elif owner.startswith("memory."):
            found.add(owner)
    if case.slot == "losses":
        given = case.component.requires(case.config)
        found |= {name for name in given if name.startswith("rendering.") and name in read}
    return found

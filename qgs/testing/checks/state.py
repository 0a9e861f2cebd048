"""Inputs and parameters stay as they are, and outputs are new."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from qgs.testing.case import Case
from qgs.testing.chance import drawn_from
from qgs.testing.faults import expect
from qgs.testing.memory import remembered
from qgs.testing.modes import each_mode
from qgs.testing.registry import MODULES, check
from qgs.testing.subjects import inputs_of, tracked_inputs
from qgs.testing.trees import cloned, described, difference, leaves, scalar
from qgs.types import QueryState


@check(MODULES)
def check_inputs_are_not_changed(case: Case) -> None:
    """Neither the forward nor the backward pass changes an input, in numbers or in names."""
    module = case.lively()
    for mode in each_mode(module):
        inputs = tracked_inputs(case, inputs_of(case))
        before = cloned(inputs)
        outputs = module(*inputs.values())
        found = difference(before, cloned(inputs))
        expect(not found, f"after the forward pass in {mode} the inputs differ: {found}")
        total = scalar(outputs)
        if total.requires_grad:
            total.backward()
        found = difference(before, cloned(inputs))
        expect(not found, f"after the backward pass in {mode} the inputs differ: {found}")


@check(MODULES - {"queries"})
def check_outputs_share_no_memory(case: Case) -> None:
    """What a component computes lies in memory of its own: not in that of its inputs or weights.

    Buffers are weights here.
    """
    module, inputs = case.lively(), inputs_of(case)
    outputs = leaves(module(*inputs.values()))
    taken = {x.untyped_storage().data_ptr(): n for n, x in leaves(inputs).items() if x.numel()}
    taken |= {x.untyped_storage().data_ptr(): n for n, x in _tensors(module).items()}
    provided = {f"fields.{name}" for name in case.component.provides(case.config)}
    for name, tensor in outputs.items():
        if case.slot == "refinement" and name not in provided:
            continue  # passed on as it is
        owner = taken.get(tensor.untyped_storage().data_ptr()) if tensor.numel() else None
        expect(owner is None, f"`{name}` lies in the memory of `{owner}`")


@check(MODULES)
def check_forward_keeps_no_state(case: Case) -> None:
    """A forward pass leaves no trace: in no parameter, buffer or attribute, a private one or not.

    In training as in evaluation; the next pass gives what it gives as the first one. What is to be
    computed once for all layers belongs into `ImageMemory.once`, what depends on sizes alone into a
    function of them.
    """
    module = case.lively()
    for mode in each_mode(module):
        before, kept = cloned(_tensors(module)), remembered(module)
        module(*inputs_of(case).values())
        found = difference(before, _tensors(module))
        expect(not found, f"a forward pass in {mode} changes the state: {found}")
        now = remembered(module)
        changed = sorted(n for n in kept.keys() | now.keys() if kept.get(n) != now.get(n))
        expect(not changed, f"a forward pass in {mode} changes {', '.join(changed)}")
        _expect_first_equals_later(case, module, mode)


def _expect_first_equals_later(case: Case, module: Any, mode: str) -> None:
    """What an instance gives that was called before is what a new one gives."""
    inputs = inputs_of(case, seed=1)
    fresh = case.lively().train(mode == "training")
    outputs = []
    for instance in (fresh, module):
        with drawn_from(0), torch.no_grad():
            outputs.append(instance(*inputs.values()))
    found = difference(*outputs)
    expect(not found, f"after a forward pass in {mode} another one differs: {found}")


@check({"refinement", "queries"})
def check_writes_equal_provides(case: Case) -> None:
    """The fields that are written are those in `provides`, in the shape and dtype given there."""
    module = case.lively()
    for mode in each_mode(module):
        with drawn_from(0):
            _expect_declared(case, module, mode)


def _expect_declared(case: Case, module: Any, mode: str) -> None:
    inputs = inputs_of(case)
    before: dict[str, Tensor] = {}
    if case.slot == "refinement":
        state = inputs["state"]
        unrelated = {"unrelated.field": torch.randn(*state.features.shape[:2], 3)}
        inputs = {"state": state.replace(fields=unrelated)}
        before = dict(inputs["state"].fields)
    output = module(*inputs.values())
    expect(isinstance(output, QueryState), f"it gives a {type(output).__name__}")
    provided = case.component.provides(case.config)
    written = {n for n, x in output.fields.items() if n not in before or not _same(x, before[n])}
    beyond, left_out = written - set(provided), set(provided) - written
    expect(not beyond, f"in {mode} it writes {_names(beyond)} besides")
    expect(not left_out, f"in {mode} it does not write {_names(left_out)}")
    lost = set(before) - set(output.fields)
    expect(not lost, f"in {mode} it loses {_names(lost)}")
    if case.slot == "refinement":
        passed = _same(output.features, inputs["state"].features)
        expect(passed, f"in {mode} it changes the features, which a refinement passes on")
    for name, spec in provided.items():
        kept = output[name].dtype == spec.dtype
        expect(kept, f"in {mode} `{name}` is {described(output[name])}, declared as {spec}")


def _same(one: Tensor, other: Tensor) -> bool:
    return one is other or (one.data_ptr() == other.data_ptr() and one.shape == other.shape)


def _names(names: set[str]) -> str:
    return ", ".join(sorted(names))


def _tensors(module: torch.nn.Module) -> dict[str, Tensor]:
    """Parameters and buffers, those that are not saved too."""
    return dict(module.named_parameters()) | dict(module.named_buffers())

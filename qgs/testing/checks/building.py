"""Building a component, and importing its module."""

from __future__ import annotations

import inspect

import torch
from torch import nn

from qgs.testing.audit import watched
from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.other_process import ask
from qgs.testing.registry import ALL_SLOTS, PARAMETRIC, check


@check(PARAMETRIC)
def check_builds_on_meta(case: Case) -> None:
    """Built under the meta device, a component allocates no parameter and no buffer."""
    with torch.device("meta"):
        module = case.construct()
    names = dict(module.named_parameters()) | dict(module.named_buffers())
    real = [name for name, tensor in names.items() if tensor.device.type != "meta"]
    expect(not real, f"{', '.join(real)} is allocated; leave the device to the caller")


@check(PARAMETRIC)
def check_registers_its_parameters(case: Case) -> None:
    """Every tensor that a component keeps is a parameter or a buffer, so that it moves along."""
    module = case.build()
    for name, part in module.named_modules():
        kept = [key for key, value in vars(part).items() if isinstance(value, torch.Tensor)]
        hidden = [
            key
            for key, value in vars(part).items()
            if isinstance(value, list | tuple)
            and any(isinstance(item, torch.Tensor | nn.Module) for item in value)
        ]
        where = f"{name or 'the component'} keeps {', '.join(kept + hidden)}"
        expect(not kept + hidden, f"{where} outside of its parameters, buffers and modules")


@check(ALL_SLOTS - {"data"})
def check_build_does_no_io(case: Case) -> None:
    """Building opens no file and no connection and starts no process."""
    with watched(inspect.getfile(case.component)) as events:
        case.build()
    expect(not events, f"while it is built: {', '.join(events)}")


@check(ALL_SLOTS)
def check_import_does_no_io(case: Case) -> None:
    """Importing the module opens no file but code, no connection, and starts no process."""
    events = ask("import", case)["events"]
    expect(not events, f"while {case.component.__module__} is imported: {', '.join(events)}")

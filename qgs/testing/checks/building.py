"""Building a component, and importing its module."""

from __future__ import annotations

import inspect

import torch
from torch import nn

from qgs.composer.registry import package_of
from qgs.testing.audit import watched
from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.memory import is_torchs_own
from qgs.testing.other_process import ask
from qgs.testing.registry import ALL_SLOTS, PARAMETRIC, check

SHOWN = 5
"""Files and connections that a message names."""


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
    """Every tensor that a component keeps is a parameter or a buffer, so that it moves along.

    Torch's own layers may list their parameters a second time, as its recurrent ones do.
    """
    module = case.build()
    for name, part in module.named_modules():
        kept = [key for key, value in vars(part).items() if isinstance(value, torch.Tensor)]
        hidden = [] if is_torchs_own(part) else _lists_of_tensors(part)
        where = f"{name or 'the component'} keeps {', '.join(kept + hidden)}"
        expect(not kept + hidden, f"{where} outside of its parameters, buffers and modules")


@check(ALL_SLOTS - {"data"})
def check_build_does_no_io(case: Case) -> None:
    """Building touches no file, opens no connection and starts no process."""
    with watched() as deeds:
        case.build()
    package = package_of(inspect.getfile(case.component))
    own = [deed.text for deed in deeds if deed.is_done_by(package)]
    expect(not own, f"while it is built: {_listed(own)}")


@check(ALL_SLOTS)
def check_import_does_no_io(case: Case) -> None:
    """Importing the package touches no file but code, opens no connection, starts no process."""
    deeds = ask("import", case)["deeds"]
    expect(not deeds, f"while {case.component.__module__} is imported: {_listed(deeds)}")


def _lists_of_tensors(part: nn.Module) -> list[str]:
    """Names of the lists and tuples that a module keeps tensors or modules in."""
    return [
        key
        for key, value in vars(part).items()
        if isinstance(value, list | tuple)
        and any(isinstance(item, torch.Tensor | nn.Module) for item in value)
    ]


def _listed(deeds: list[str]) -> str:
    first, more = ", ".join(deeds[:SHOWN]), len(deeds) - SHOWN
    return first if more <= 0 else f"{first} and {more} more"

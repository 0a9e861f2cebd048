"""Weights are saved and come back."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from safetensors.torch import load_file, save_file

from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.other_process import ask
from qgs.testing.registry import PARAMETRIC, check
from qgs.testing.subjects import inputs_of
from qgs.testing.trees import difference, leaves


@check(PARAMETRIC)
def check_saved_weights_run_elsewhere(case: Case) -> None:
    """Saved as safetensors and loaded in a new process, a component gives the same bits.

    What it was called with before, in the process that saved it, makes no difference.
    """
    module, inputs = case.lively(), inputs_of(case, seed=1)
    with torch.no_grad():
        module(*inputs_of(case).values())
        expected = leaves(module(*inputs.values()))
    with TemporaryDirectory() as folder:
        paths = {name: str(Path(folder) / name) for name in ("weights", "inputs", "outputs")}
        save_file(_own(dict(module.state_dict())), paths["weights"])
        save_file(_own(leaves(inputs)), paths["inputs"])
        ask("run", case, **paths)
        found = difference(expected, load_file(paths["outputs"]))
    expect(not found, f"in a new process {found}")


@check(PARAMETRIC)
def check_state_dict_is_complete(case: Case) -> None:
    """The state dict of one instance makes any other one its equal, to the bit."""
    module, other, inputs = case.lively(seed=1), case.build(seed=2).eval(), inputs_of(case)
    other.load_state_dict(module.state_dict())
    found = difference(module(*inputs.values()), other(*inputs.values()))
    expect(not found, f"with the same state dict, {found}")


@check(PARAMETRIC)
def check_state_dict_keys(case: Case) -> None:
    """Names and shapes in the state dict are the same each time, and as pinned in the case."""
    module = case.build()
    shapes = {name: tuple(x.shape) for name, x in module.state_dict().items()}
    module(*inputs_of(case).values())
    again = {name: tuple(x.shape) for name, x in case.build(seed=1).state_dict().items()}
    expect(shapes == again, f"the second instance has {again}, the first {shapes}")
    expect(set(shapes) == set(module.state_dict()), "a forward pass changes the names")
    if case.state_dict is not None:
        pinned = {name: tuple(shape) for name, shape in case.state_dict.items()}
        moved = sorted(set(pinned.items()) ^ set(shapes.items()))
        expect(not moved, f"pinned and present differ in {moved}; saved weights would not load")


def _own(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}

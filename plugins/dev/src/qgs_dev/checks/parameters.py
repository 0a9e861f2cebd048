"""Parameters: how they are drawn, where they are kept, saved and moved, and that they learn."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy
import torch
from safetensors.torch import load, save
from torch import Tensor, nn

from qgs.containers import map_tensors
from qgs.recipe.build import OnMeta
from qgs_dev.case import Case, expect
from qgs_dev.inputs import inputs_of
from qgs_dev.modules import seeded
from qgs_dev.registry import PARAMETRIC, check
from qgs_dev.trees import cast, difference, floating, not_finite, scalar, tracked

ROUNDING = 1e-8
"""Share of the largest gradient that float32 inside of a float64 component leaves of none."""


@check(PARAMETRIC, tier="construction")
def check_builds_on_meta(case: Case) -> None:
    """Built under the meta device, a component allocates no parameter and no buffer."""
    with torch.device("meta"), OnMeta():
        module = case.construct()
    names = dict(module.named_parameters()) | dict(module.named_buffers())
    real = [name for name, tensor in names.items() if tensor.device.type != "meta"]
    expect(not real, f"{', '.join(real)} is allocated; leave the device to the caller")


@check(PARAMETRIC, tier="construction")
def check_registers_its_parameters(case: Case) -> None:
    """Every tensor that a component keeps is a parameter or a buffer, so that it moves along.

    Torch's own layers may list their parameters a second time, as its recurrent ones do.
    """
    for name, part in case.build().named_modules():
        lists = () if type(part).__module__.startswith("torch.") else (list, tuple)
        kept = [
            key
            for key, value in vars(part).items()
            if isinstance(value, Tensor)
            or (isinstance(value, lists) and any(isinstance(x, Tensor | nn.Module) for x in value))
        ]
        where = f"{name or 'the component'} keeps {', '.join(kept)}"
        expect(not kept, f"{where} outside of its parameters, buffers and modules")


@check(PARAMETRIC, tier="construction")
def check_same_seed_same_parameters(case: Case) -> None:
    """Initial parameters are drawn from torch's global generator alone, which is not seeded.

    Two instances built from one seed have the same parameters, to the bit.
    """
    others, after = other_generators(), []
    for seed in (1, 2):
        with seeded(seed):
            case.construct()
            after.append(torch.get_rng_state())
    expect(not torch.equal(*after), "after being built from two seeds, torch is in one state")
    expect(others == other_generators(), "building draws from numpy's or random's generator")
    first, second = (dict(case.build(seed=3).state_dict()) for _ in range(2))
    found = difference(first, second)
    expect(not found, f"two instances built from one seed differ: {found}")


def other_generators() -> tuple[Any, str]:
    """The states of the random generators that components must not use."""
    return random.getstate(), str(numpy.random.get_state())


@check(PARAMETRIC, tier="construction")
def check_saved_weights_load(case: Case) -> None:
    """Weights saved as safetensors and loaded into a new instance give the same bits."""
    module, other, inputs = case.lively(seed=1), case.build(seed=2).eval(), inputs_of(case)
    weights = {name: x.contiguous() for name, x in module.state_dict().items()}
    other.load_state_dict(load(save(weights)))
    found = difference(module(*inputs.values()), other(*inputs.values()))
    expect(not found, f"with the same state dict, {found}")


@check(PARAMETRIC, variants=True)
def check_state_dict_keys(case: Case) -> None:
    """Names and shapes in the state dict are as pinned in the case; a forward pass keeps them."""
    module = case.build()
    shapes = {name: tuple(x.shape) for name, x in module.state_dict().items()}
    module(*inputs_of(case).values())
    expect(set(shapes) == set(module.state_dict()), "a forward pass changes the names")
    if case.state_dict is not None:
        pinned = {name: tuple(shape) for name, shape in case.state_dict.items()}
        moved = sorted(set(pinned.items()) ^ set(shapes.items()))
        expect(not moved, f"pinned and present differ in {moved}; saved weights would not load")


@check(PARAMETRIC, tier="construction")
def check_moves_to_a_device(case: Case) -> None:
    """Moved to another device (CUDA, else meta), a component computes there, without the CPU."""
    device = "cuda" if torch.cuda.is_available() else "meta"
    module = case.lively().to(device)
    inputs = tracked(map_tensors(lambda x: x.to(device), inputs_of(case)))
    with _autocast_accepts_meta():
        outputs = floating(module(*inputs.values()))
    for name, tensor in outputs.items():
        moved = tensor.device.type == device
        expect(moved, f"`{name}` is on {tensor.device}, the component on {device}")
    totals = [x.sum() for x in outputs.values() if x.requires_grad]
    if totals:
        torch.autograd.backward(totals)


@contextmanager
def _autocast_accepts_meta() -> Iterator[None]:
    """`torch.autocast(x.device.type, enabled=False)` is valid code, which torch refuses on meta."""
    start = torch.autocast.__init__

    def begin(self: Any, device_type: str, *args: Any, **kwargs: Any) -> None:
        start(self, "cpu" if device_type == "meta" else device_type, *args, **kwargs)

    with patch.object(torch.autocast, "__init__", begin):
        yield


@check(PARAMETRIC)
@seeded(0)
def check_parameters_learn(case: Case) -> None:
    """Every trainable parameter gets a finite, non-zero gradient within two optimiser steps.

    A gradient below ROUNDING times the largest of another parameter is a rounding error.
    A component that draws numbers in training, as to leave a layer out, has twelve steps. Weights
    of a release that change nothing are named by the module that has them, in `unlearned`.
    """
    module = case.build().double().train()
    unlearned = {
        f"{place}.{name}".lstrip(".")
        for place, part in module.named_modules()
        for name in getattr(part, "unlearned", ())
    }
    parameters = {
        name: parameter
        for name, parameter in module.named_parameters()
        if parameter.requires_grad and name not in unlearned
    }
    if not parameters:
        return
    optimizer = torch.optim.SGD(parameters.values(), lr=0.01)
    learned = set[str]()
    for step in range(12):
        before = torch.get_rng_state()
        optimizer.zero_grad()
        total = scalar(module(*cast(inputs_of(case, seed=step), torch.float64).values()))
        if total.requires_grad:
            total.backward()
        gradients = {n: p.grad for n, p in parameters.items() if p.grad is not None}
        broken = not_finite(gradients)
        expect(not broken, f"the gradient of {', '.join(broken)} is not finite in step {step + 1}")
        sizes = {name: gradient.abs().max().item() for name, gradient in gradients.items()}
        least = ROUNDING * max(sizes.values(), default=0.0)
        learned |= {name for name, size in sizes.items() if size > least}
        torch.nn.utils.clip_grad_norm_(parameters.values(), 1.0)
        optimizer.step()
        draws_nothing = torch.equal(before, torch.get_rng_state())
        if step and (draws_nothing or len(learned) == len(parameters)):
            break
    idle = [name for name in parameters if name not in learned]
    expect(not idle, f"no gradient reaches {', '.join(idle)}: use it or name it in `unlearned`")

"""Parameters and state: drawn, kept, saved, moved, learned; a forward pass changes none of it."""

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
from qgs_dev.case import Case
from qgs_dev.inputs import Inputs, inputs_of
from qgs_dev.modules import attributes, each_mode, seeded, tensors_of
from qgs_dev.vocabulary import (
    Trial,
    cast,
    cloned,
    expect,
    expect_finite,
    expect_none,
    expect_same,
    floating,
    leaves,
    scalar,
    tracked,
)

# Share of the largest gradient that float32 inside of a float64 component leaves of none.
ROUNDING = 1e-8


def check_builds_on_meta(case: Case) -> None:
    """Built under the meta device, a component allocates no parameter and no buffer."""
    with torch.device("meta"), OnMeta():
        module = case.construct()
    real = [name for name, tensor in tensors_of(module).items() if not tensor.is_meta]
    expect_none(real, "allocated; leave the device to the caller")


def check_registers_its_parameters(case: Case) -> None:
    """Every tensor that a component keeps is a parameter or a buffer, so that it moves along.

    Torch's own layers may list their parameters a second time, as its recurrent ones do.
    """
    for name, part in case.build().named_modules():
        of_torch = type(part).__module__.startswith("torch.")
        for key, value in vars(part).items():
            listed = value if isinstance(value, list | tuple) and not of_torch else ()
            kept = [value] if isinstance(value, Tensor) else listed
            outside = any(isinstance(x, Tensor | nn.Module) for x in kept)
            where = f"{name or 'the component'} keeps {key}"
            expect(not outside, f"{where} outside of its parameters, buffers and modules")


def check_same_seed_same_parameters(case: Case) -> None:
    """Initial parameters are drawn from torch's global generator alone, which is not seeded.

    Two instances built from one seed have the same parameters, to the bit.
    """
    # Training resumes torch's generator alone.
    others = other_generators()
    after = []
    for seed in (1, 2):
        with seeded(seed):
            case.construct()
            after.append(torch.get_rng_state())
    expect(not torch.equal(*after), "after being built from two seeds, torch is in one state")
    expect(others == other_generators(), "building draws from numpy's or random's generator")
    first, second = (dict(case.build(seed=3).state_dict()) for _ in range(2))
    expect_same(first, second, "two instances built from one seed differ")


def other_generators() -> tuple[Any, str]:
    """The states of the random generators that components must not use."""
    return random.getstate(), str(numpy.random.get_state())


def check_saved_weights_load(case: Case) -> None:
    """Weights saved as safetensors and loaded into a new instance give the same bits."""
    module = case.lively(seed=1)
    other = case.build(seed=2).eval()
    weights = {name: x.contiguous() for name, x in module.state_dict().items()}
    other.load_state_dict(load(save(weights)))
    inputs = inputs_of(case).values()
    expect_same(module(*inputs), other(*inputs), "with the same state dict")


def check_state_dict_keys(case: Case) -> None:
    """Names and shapes in the state dict are as pinned in the case; a forward pass keeps them."""
    module = case.build()
    shapes = {name: tuple(x.shape) for name, x in module.state_dict().items()}
    module(*inputs_of(case).values())
    expect(shapes.keys() == module.state_dict().keys(), "a forward pass changes the names")
    if case.state_dict is not None:
        pinned = {name: tuple(shape) for name, shape in case.state_dict.items()}
        moved = pinned.items() ^ shapes.items()
        expect_none(moved, "pinned or present, not both; saved weights would not load")


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
    # The backward pass has devices of its own.
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
    idle = {*parameters}
    for step in range(12):
        before = torch.get_rng_state()
        optimizer.zero_grad()
        total = scalar(module(*cast(inputs_of(case, seed=step), torch.float64).values()))
        if total.requires_grad:
            total.backward()
        found = {name: x.grad for name, x in parameters.items() if x.grad is not None}
        expect_finite(found, f"in its gradient in step {step + 1}")
        sizes = {name: gradient.abs().max().item() for name, gradient in found.items()}
        least = ROUNDING * max(sizes.values(), default=0.0)
        idle -= {name for name, size in sizes.items() if size > least}
        # A long step would close every ReLU.
        torch.nn.utils.clip_grad_norm_(parameters.values(), 1.0)
        optimizer.step()
        # Two steps are enough where nothing is drawn: zero-initialised layers learn in the second.
        draws_nothing = torch.equal(before, torch.get_rng_state())
        if step and (draws_nothing or not idle):
            break
    expect_none(idle, "no gradient reaches it; use it or name it in `unlearned`")


def check_inputs_are_not_changed(case: Case) -> None:
    """Neither the forward nor the backward pass changes an input, in numbers or in names."""
    trial = Trial(case)
    for mode in each_mode(trial.module):
        inputs = trial.tracked()
        before = cloned(inputs)
        total = scalar(trial(inputs))
        expect_same(before, inputs, f"after the forward pass in {mode} the inputs differ")
        if total.requires_grad:
            total.backward()
        expect_same(before, inputs, f"after the backward pass in {mode} the inputs differ")


def check_outputs_share_no_memory(case: Case) -> None:
    """Outputs that a component computes share no memory with its inputs or weights.

    Buffers are weights here. A refinement, a layer and a feedback may hand on the fields that they
    do not provide, the latter two the memory too, and a feedback the features.
    """
    trial = Trial(case)
    outputs = leaves(trial())
    tensors = leaves(trial.inputs) | tensors_of(trial.module)
    # Views of one memory have one storage.
    owners = {x.untyped_storage().data_ptr(): name for name, x in tensors.items() if x.numel()}
    provided = [f"fields.{name}" for name in case.writes]
    of_state = [f"0.{name}" for name in provided]
    own = {"refinement": provided, "feedback": of_state, "layer": ["0.features", *of_state]}
    for name in own.get(case.slot, outputs):
        tensor = outputs[name]
        owner = owners.get(tensor.untyped_storage().data_ptr()) if tensor.numel() else None
        expect(owner is None, f"`{name}` lies in the memory of `{owner}`")


def check_forward_keeps_no_state(case: Case) -> None:
    """A forward pass leaves no trace: in no parameter, buffer or attribute, private or not.

    In training as in evaluation; the next pass gives what it gives as the first one. What is to be
    computed once for all layers belongs into `ImageMemory.once`, what depends on sizes alone into a
    function of them.
    """
    trial = Trial(case)
    module = trial.module
    for mode in each_mode(module):
        before = cloned(tensors_of(module))
        kept = attributes(module)
        trial()
        expect_same(before, tensors_of(module), f"a forward pass in {mode} changes the state")
        now = attributes(module)
        changed = [name for name in kept.keys() | now.keys() if kept.get(name) != now.get(name)]
        expect_none(changed, f"changed by a forward pass in {mode}")
        # What a pass leaves in a closure no attribute shows: the next pass does.
        fresh = case.lively().train(mode == "training")
        inputs = inputs_of(case, seed=1)
        first, later = (_outputs(one, inputs, 0)[0] for one in (fresh, module))
        expect_same(first, later, f"after a forward pass in {mode} another one differs")


def check_eval_repeats_bitwise(case: Case) -> None:
    """In evaluation the same inputs give the same outputs, to the bit, and nothing is drawn.

    Every global random state stays as it was.
    """
    trial = Trial(case)
    others = other_generators()
    torchs = torch.get_rng_state()
    first = trial()
    trial(inputs_of(case, seed=1))
    expect_same(first, trial(inputs_of(case)), "the second time")
    expect(torch.equal(torchs, torch.get_rng_state()), "it draws from torch's generator")
    expect(others == other_generators(), "it draws from numpy's or random's generator")


def check_training_draws_from_torch(case: Case) -> None:
    """In training, random numbers come from torch's global generator alone, which nothing seeds."""
    module = case.lively().train()
    before = other_generators()
    first, other, again = (_outputs(module, inputs_of(case), seed) for seed in (1, 2, 1))
    expect(before == other_generators(), "in training it uses numpy's or random's generator")
    reseeded = torch.equal(first[1], other[1])
    expect(not reseeded, "after training passes from two seeds, torch is in one state")
    expect_same(first[0], again[0], "two training passes from one seed differ")


def _outputs(module: Any, inputs: Inputs, seed: int) -> tuple[Any, torch.Tensor]:
    """Outputs of a forward pass under `seed`, and torch's random state after it."""
    with seeded(seed), torch.no_grad():
        outputs = cloned(module(*inputs.values()))
        return outputs, torch.get_rng_state()

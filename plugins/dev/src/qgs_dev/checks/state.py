"""Parameters and state: parameters learn, and a forward pass changes nothing that is kept."""

from typing import Any

import torch
from pydantic import ValidationError

from qgs.contracts import ComponentConfig
from qgs_dev.case import Case
from qgs_dev.checks.basics import other_generators
from qgs_dev.checks.judging import rehearsed
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
    leaves,
    scalar,
)

# Share of the largest gradient that float32 inside of a float64 component leaves of none.
ROUNDING = 1e-8


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


def check_state_dict_keys(case: Case) -> None:
    """Names and shapes in the state dict are as pinned in the case, if it pins any."""
    if case.state_dict is None:
        return
    shapes = {name: tuple(x.shape) for name, x in case.build().state_dict().items()}
    pinned = {name: tuple(shape) for name, shape in case.state_dict.items()}
    moved = pinned.items() ^ shapes.items()
    expect_none(moved, "pinned or present, not both; saved weights would not load")


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


def check_scheduled_options_are_read_anew(case: Case) -> None:
    """An option in `scheduled` counts in the next call once it is changed, as if built with it.

    What a component requires and provides does not depend on it.
    """
    for option in sorted(case.component.scheduled):
        other = case.with_config(_with_another(case.config, option))
        if other.config == case.config or other.problems(case.size):
            continue
        what = f"`{option}: {getattr(other.config, option)}`"
        same = dict(other.reads) == dict(case.reads) and dict(other.writes) == dict(case.writes)
        expect(same, f"{what} changes what it requires or provides")
        module = _ready(case)
        # A first call may keep what the second must read anew.
        _called(case, module)
        module.config = other.config
        where = f"with {what} set after it was built"
        expect_same(_called(case, _ready(other)), _called(case, module), where)


def _with_another(config: ComponentConfig, option: str) -> ComponentConfig:
    """Return `config` with half or twice a number, or 0.5 for 0; itself if neither is allowed."""
    value = getattr(config, option)
    for other in (value / 2, 2 * value) if value else (0.5, 1):
        try:
            changed = {**dict(config), option: type(value)(other)}
            return type(config).model_validate(changed)
        except (ValidationError, TypeError):
            continue
    return config


def _ready(case: Case) -> Any:
    return case.build() if case.slot == "objective" else case.lively()


def _called(case: Case, module: Any) -> Any:
    if case.slot == "objective":
        return rehearsed(case, module)
    with seeded(0):
        return module(*inputs_of(case).values())

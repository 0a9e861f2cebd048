"""Checks that parameters learn and that a forward pass changes no state."""

from typing import Any

import torch
from pydantic import ValidationError

from qgs.checkpoint.tensors import shapes_of
from qgs.contracts import ComponentConfig
from qgs_dev.case import Case, seeded
from qgs_dev.checks.basics import other_generators
from qgs_dev.checks.judging import rehearsed
from qgs_dev.inputs import Inputs, inputs_of
from qgs_dev.vocabulary import (
    Trial,
    attributes,
    cast,
    cloned,
    each_mode,
    expect,
    expect_finite,
    expect_none,
    expect_same,
    leaves,
    scalar,
    tensors_of,
)

# Share of the largest gradient below which a gradient is a rounding error of float32.
ROUNDING = 1e-8


@seeded(0)
def check_parameters_learn(case: Case) -> None:
    """Require that every trainable parameter gets a finite, non-zero gradient within two steps.

    Gradients below ROUNDING times the largest one count as zero. A component that uses random
    numbers in training, for example to skip a layer, has twelve steps. A module with parameters
    that have no effect, for compatibility with published weights, lists their names in `unlearned`.
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
        # Two steps are enough without random draws: zero-initialised layers learn in the second.
        draws_nothing = torch.equal(before, torch.get_rng_state())
        if step and (draws_nothing or not idle):
            break
    expect_none(idle, "no gradient reaches it; use it or list it in `unlearned`")


def check_state_dict_keys(case: Case) -> None:
    """Require that the state dict has the names and shapes in `Case.state_dict`, if it is given."""
    if case.state_dict is None:
        return
    shapes = shapes_of(case.build().state_dict())
    pinned = {name: tuple(shape) for name, shape in case.state_dict.items()}
    moved = pinned.items() ^ shapes.items()
    expect_none(moved, "either expected or present, but not both; saved weights would not load")


def check_inputs_are_not_changed(case: Case) -> None:
    """Require that forward and backward passes do not change the inputs."""
    trial = Trial(case)
    for mode in each_mode(trial.module):
        inputs = trial.tracked()
        before = cloned(inputs)
        total = scalar(trial(inputs))
        expect_same(before, inputs, f"the forward pass in {mode} changes inputs")
        if total.requires_grad:
            total.backward()
        expect_same(before, inputs, f"the backward pass in {mode} changes inputs")


def check_outputs_share_no_memory(case: Case) -> None:
    """Require that outputs share no memory with inputs, parameters or buffers.

    Inputs that a component passes on unchanged are not checked: query fields that it does not
    write, the query features in a refinement, the image memory in a layer, and both of these in a
    feedback.
    """
    trial = Trial(case)
    outputs = leaves(trial())
    tensors = leaves(trial.inputs) | tensors_of(trial.module)
    # Views of the same memory share one storage.
    owners = {x.untyped_storage().data_ptr(): name for name, x in tensors.items() if x.numel()}
    provided = [f"fields.{name}" for name in case.writes]
    of_state = [f"0.{name}" for name in provided]
    own = {"refinement": provided, "feedback": of_state, "layer": ["0.features", *of_state]}
    for name in own.get(case.slot, outputs):
        tensor = outputs[name]
        owner = owners.get(tensor.untyped_storage().data_ptr()) if tensor.numel() else None
        expect(owner is None, f"output `{name}` shares memory with `{owner}`")


def check_forward_keeps_no_state(case: Case) -> None:
    """Require that a forward pass changes no parameter, buffer or attribute, public or private.

    The check runs in training and in evaluation. A second pass must give the same results as the
    first pass of a new instance. To share a value among layers, use `ImageMemory.once`. To cache a
    value that depends on sizes only, use a cached function of the sizes.
    """
    trial = Trial(case)
    module = trial.module
    for mode in each_mode(module):
        before = cloned(tensors_of(module))
        kept = attributes(module)
        trial()
        expect_same(
            before, tensors_of(module), f"a forward pass in {mode} changes a parameter or buffer"
        )
        now = attributes(module)
        changed = [name for name in kept.keys() | now.keys() if kept.get(name) != now.get(name)]
        expect_none(changed, f"changed by a forward pass in {mode}")
        # A pass may store values in a closure. Only the next pass shows these.
        fresh = case.lively().train(mode == "training")
        inputs = inputs_of(case, seed=1)
        first, later = (_outputs(one, inputs, 0)[0] for one in (fresh, module))
        expect_same(first, later, f"a second forward pass in {mode} differs from a first one")


def check_eval_repeats_bitwise(case: Case) -> None:
    """Require bitwise equal outputs for equal inputs in evaluation, without random numbers.

    The states of all global random generators must not change.
    """
    trial = Trial(case)
    others = other_generators()
    torchs = torch.get_rng_state()
    first = trial()
    trial(inputs_of(case, seed=1))
    expect_same(first, trial(inputs_of(case)), "a second pass on the same inputs differs")
    expect(torch.equal(torchs, torch.get_rng_state()), "the component draws from torch's generator")
    expect(others == other_generators(), "the component draws from numpy's or random's generator")


def check_training_draws_from_torch(case: Case) -> None:
    """Require that training uses only torch's global random generator, and never seeds it."""
    module = case.lively().train()
    before = other_generators()
    first, other, again = (_outputs(module, inputs_of(case), seed) for seed in (1, 2, 1))
    expect(before == other_generators(), "training draws from numpy's or random's generator")
    reseeded = torch.equal(first[1], other[1])
    expect(not reseeded, "a training pass sets the seed of torch's generator")
    expect_same(first[0], again[0], "two training passes from the same seed differ")


def _outputs(module: Any, inputs: Inputs, seed: int) -> tuple[Any, torch.Tensor]:
    """Return outputs of a forward pass with random `seed`, and torch's random state after it."""
    with seeded(seed), torch.no_grad():
        outputs = cloned(module(*inputs.values()))
        return outputs, torch.get_rng_state()


def check_scheduled_options_are_read_anew(case: Case) -> None:
    """Require that a change of a scheduled option takes effect in the next call.

    Scheduled options, which a component lists in `scheduled`, may change during training. After a
    change, results must be those of a component built with the new value. The fields that the
    component requires and provides must not depend on such an option.
    """
    for option in sorted(case.component.scheduled):
        other = case.with_config(_with_another(case.config, option))
        if other.config == case.config or other.problems(case.size):
            continue
        what = f"`{option}: {getattr(other.config, option)}`"
        same = dict(other.reads) == dict(case.reads) and dict(other.writes) == dict(case.writes)
        expect(same, f"{what} changes what the component requires or provides")
        module = _ready(case)
        # A first call may store a value that the second call must read again.
        _called(case, module)
        module.config = other.config
        where = f"{what} set later gives other results than when built with it"
        expect_same(_called(case, _ready(other)), _called(case, module), where)


def _with_another(config: ComponentConfig, option: str) -> ComponentConfig:
    """Return `config` with another valid value of `option`, or `config` if no value tried is valid.

    Half and twice the value are tried, or 0.5 and 1 for a value of 0.
    """
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
    return _outputs(module, inputs_of(case), 0)[0]

"""A forward pass changes nothing and repeats: inputs, parameters, memory, random state."""

from typing import Any

import torch

from qgs_dev.case import Case, expect
from qgs_dev.checks.parameters import other_generators
from qgs_dev.inputs import inputs_of, tracked_inputs
from qgs_dev.modules import attributes, each_mode, seeded, tensors_of
from qgs_dev.registry import MODULES, check
from qgs_dev.trees import cloned, difference, leaves, scalar


@check(MODULES)
def check_inputs_are_not_changed(case: Case) -> None:
    """Neither the forward nor the backward pass changes an input, in numbers or in names."""
    module = case.lively()
    for mode in each_mode(module):
        inputs = tracked_inputs(case, inputs_of(case))
        before = cloned(inputs)
        total = scalar(module(*inputs.values()))
        found = difference(before, inputs)
        expect(not found, f"after the forward pass in {mode} the inputs differ: {found}")
        if total.requires_grad:
            total.backward()
        found = difference(before, inputs)
        expect(not found, f"after the backward pass in {mode} the inputs differ: {found}")


@check(MODULES - {"queries"})
def check_outputs_share_no_memory(case: Case) -> None:
    """What a component computes lies in memory of its own: not in that of its inputs or weights.

    Buffers are weights here. A refinement, a layer and a feedback may hand on the fields that they
    do not provide, the latter two the memory too, and a feedback the features.
    """
    module, inputs = case.lively(), inputs_of(case)
    outputs = leaves(module(*inputs.values()))
    tensors = [*leaves(inputs).items(), *tensors_of(module).items()]
    owners = {x.untyped_storage().data_ptr(): name for name, x in tensors if x.numel()}
    provided = [f"fields.{name}" for name in case.component.fields_written(case.config)]
    of_state = [f"0.{name}" for name in provided]
    own = {"refinement": provided, "feedback": of_state, "layer": ["0.features", *of_state]}
    for name, tensor in outputs.items():
        if name not in own.get(case.slot, outputs):
            continue
        owner = owners.get(tensor.untyped_storage().data_ptr()) if tensor.numel() else None
        expect(owner is None, f"`{name}` lies in the memory of `{owner}`")


@check(MODULES)
def check_forward_keeps_no_state(case: Case) -> None:
    """A forward pass leaves no trace: in no parameter, buffer or attribute, private or not.

    In training as in evaluation; the next pass gives what it gives as the first one. What is to be
    computed once for all layers belongs into `ImageMemory.once`, what depends on sizes alone into a
    function of them.
    """
    module = case.lively()
    for mode in each_mode(module):
        before, kept = cloned(tensors_of(module)), attributes(module)
        module(*inputs_of(case).values())
        found = difference(before, tensors_of(module))
        expect(not found, f"a forward pass in {mode} changes the state: {found}")
        now = attributes(module)
        changed = sorted(n for n in kept.keys() | now.keys() if kept.get(n) != now.get(n))
        expect(not changed, f"a forward pass in {mode} changes {', '.join(changed)}")
        fresh, inputs = case.lively().train(mode == "training"), inputs_of(case, seed=1)
        first, later = (_outputs(one, inputs, 0)[0] for one in (fresh, module))
        found = difference(first, later)
        expect(not found, f"after a forward pass in {mode} another one differs: {found}")


@check(MODULES)
def check_eval_repeats_bitwise(case: Case) -> None:
    """In evaluation the same inputs give the same outputs, to the bit, and nothing is drawn.

    Every global random state stays as it was.
    """
    module, inputs = case.lively(), inputs_of(case)
    others, torchs = other_generators(), torch.get_rng_state()
    first = module(*inputs.values())
    module(*inputs_of(case, seed=1).values())
    found = difference(first, module(*inputs_of(case).values()))
    expect(not found, f"the second time {found}")
    expect(torch.equal(torchs, torch.get_rng_state()), "it draws from torch's generator")
    expect(others == other_generators(), "it draws from numpy's or random's generator")


@check(MODULES)
def check_training_draws_from_torch(case: Case) -> None:
    """In training, random numbers come from torch's global generator alone, which nothing seeds."""
    module, before = case.lively().train(), other_generators()
    first, other, again = (_outputs(module, inputs_of(case), seed) for seed in (1, 2, 1))
    expect(before == other_generators(), "in training it uses numpy's or random's generator")
    reseeded = torch.equal(first[1], other[1])
    expect(not reseeded, "after training passes from two seeds, torch is in one state")
    found = difference(first[0], again[0])
    expect(not found, f"two training passes from one seed differ: {found}")


def _outputs(module: Any, inputs: Any, seed: int) -> tuple[Any, torch.Tensor]:
    """Outputs of a forward pass under `seed`, and torch's random state after it."""
    with seeded(seed), torch.no_grad():
        outputs = cloned(module(*inputs.values()))
        return outputs, torch.get_rng_state()

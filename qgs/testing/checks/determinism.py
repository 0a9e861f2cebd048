"""Chance enters through torch's global generator alone: in initial parameters and in training."""

from __future__ import annotations

import random
from typing import Any

import numpy
import torch

from qgs.testing.case import Case
from qgs.testing.chance import drawn_from
from qgs.testing.faults import expect
from qgs.testing.other_process import ask
from qgs.testing.registry import MODULES, PARAMETRIC, check
from qgs.testing.subjects import inputs_of
from qgs.testing.trees import cloned, difference, digests


@check(PARAMETRIC)
def check_same_seed_same_parameters(case: Case) -> None:
    """Two instances built from one seed have the same parameters, to the bit."""
    first, second = (dict(case.build(seed=3).state_dict()) for _ in range(2))
    found = difference(first, second)
    expect(not found, f"two instances built from one seed differ: {found}")


@check(PARAMETRIC)
def check_same_parameters_elsewhere(case: Case) -> None:
    """Another process builds the same parameters from the same seed, to the bit."""
    theirs = ask("build", case, seed=3)["digests"]
    ours = digests(case.build(seed=3).state_dict())
    names = sorted(ours.keys() ^ theirs.keys())
    expect(not names, f"of two processes, one has {', '.join(names)}, and the other has not")
    other = [name for name in ours if ours[name] != theirs[name]]
    expect(not other, f"from one seed, another process draws other {', '.join(other)}")


@check(PARAMETRIC)
def check_build_respects_the_seed(case: Case) -> None:
    """Building neither seeds torch's generator nor touches those of numpy and random."""
    before = _other_generators()
    after = []
    with torch.random.fork_rng(devices=()):
        for seed in (1, 2):
            torch.default_generator.manual_seed(seed)
            case.construct()
            after.append(torch.get_rng_state())
    expect(not torch.equal(*after), "after being built from two seeds, torch is in one state")
    expect(before == _other_generators(), "building draws from numpy's or random's generator")


@check(MODULES)
def check_forward_leaves_random_state(case: Case) -> None:
    """A forward pass in evaluation mode leaves every global random state untouched."""
    module, inputs = case.lively(), inputs_of(case)
    before, torch_before = _other_generators(), torch.get_rng_state()
    module(*inputs.values())
    expect(torch.equal(torch_before, torch.get_rng_state()), "it draws from torch's generator")
    expect(before == _other_generators(), "it draws from numpy's or random's generator")


@check(MODULES)
def check_training_draws_from_torch(case: Case) -> None:
    """In training, chance is drawn from torch's global generator alone, which nothing seeds."""
    module, before = case.lively().train(), _other_generators()
    first, other, again = (_training_pass(case, module, seed) for seed in (1, 2, 1))
    expect(before == _other_generators(), "in training it uses numpy's or random's generator")
    seeded = torch.equal(first[1], other[1])
    expect(not seeded, "after training passes from two seeds, torch is in one state")
    found = difference(first[0], again[0])
    expect(not found, f"two training passes from one seed differ: {found}")


def _training_pass(case: Case, module: Any, seed: int) -> tuple[Any, torch.Tensor]:
    """Outputs, and torch's random state after them, of a forward pass from `seed`."""
    with drawn_from(seed):
        outputs = cloned(module(*inputs_of(case).values()))
        return outputs, torch.get_rng_state()


@check(MODULES)
def check_eval_repeats_bitwise(case: Case) -> None:
    """In evaluation mode the same inputs give the same outputs, to the bit."""
    module, inputs = case.lively(), inputs_of(case)
    first = module(*inputs.values())
    module(*inputs_of(case, seed=1).values())
    found = difference(first, module(*inputs_of(case).values()))
    expect(not found, f"the second time {found}")


def _other_generators() -> tuple[Any, str]:
    return random.getstate(), str(numpy.random.get_state())

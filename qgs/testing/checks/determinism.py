"""Chance enters through torch's global generator alone, and only while parameters are drawn."""

from __future__ import annotations

import random
from typing import Any

import numpy
import torch

from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import MODULES, PARAMETRIC, check
from qgs.testing.subjects import inputs_of
from qgs.testing.trees import difference


@check(PARAMETRIC)
def check_same_seed_same_parameters(case: Case) -> None:
    """Two instances built from one seed have the same parameters, to the bit."""
    first, second = (dict(case.build(seed=3).state_dict()) for _ in range(2))
    found = difference(first, second)
    expect(not found, f"two instances built from one seed differ: {found}")


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
def check_eval_repeats_bitwise(case: Case) -> None:
    """In evaluation mode the same inputs give the same outputs, to the bit."""
    module, inputs = case.lively(), inputs_of(case)
    first = module(*inputs.values())
    module(*inputs_of(case, seed=1).values())
    found = difference(first, module(*inputs_of(case).values()))
    expect(not found, f"the second time {found}")


def _other_generators() -> tuple[Any, str]:
    return random.getstate(), str(numpy.random.get_state())

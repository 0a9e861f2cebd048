"""Everything that is learned can be learned."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.gradcheck import GradcheckError, gradcheck
from torch.func import functional_call

from qgs.testing.case import Case
from qgs.testing.chance import drawn_from
from qgs.testing.faults import expect
from qgs.testing.memory import is_torchs_own
from qgs.testing.modes import each_mode
from qgs.testing.registry import MODULES, PARAMETRIC, check
from qgs.testing.subjects import Inputs, Sizes, inputs_of
from qgs.testing.trees import cast, floating, mapped, scalar, tracked

SMALL = Sizes(batch=1, queries=3, views=2, gaussians=2)


CHANCES = 12
"""Optimiser steps for what chance leaves out of some of them."""

NOISE = 1e-10
"""Gradients that are rounding errors in float64, in units of the largest one."""


@check(PARAMETRIC)
@drawn_from(0)
def check_parameters_learn(case: Case) -> None:
    """Every trainable parameter gets a finite, non-zero gradient within two optimiser steps.

    More than a rounding error, that is, beside those of the other parameters and of the inputs; but
    for biases of torch's own layers: that of attention's keys is taken away by the softmax.
    Where training draws numbers, as to leave a layer out, within twelve.
    """
    module = case.build().double().train()
    parameters = {n: p for n, p in module.named_parameters() if p.requires_grad}
    if not parameters:
        return
    optimizer = torch.optim.SGD(parameters.values(), lr=0.01)
    learned, offsets = set[str](), _biases_of_layers(module)
    for step in range(CHANCES):
        state = torch.get_rng_state()
        optimizer.zero_grad()
        inputs = tracked(cast(inputs_of(case, seed=step), torch.float64))
        total = scalar(module(*inputs.values()))
        if total.requires_grad:
            total.backward()
        noise = NOISE * _steepest([*parameters.values(), *floating(inputs).values()])
        for name, parameter in parameters.items():
            slope = parameter.grad
            finite = slope is None or bool(slope.isfinite().all())
            expect(finite, f"the gradient of `{name}` is not finite in step {step + 1}")
            least = 0.0 if name in offsets else noise
            if slope is not None and slope.abs().max() > least:
                learned.add(name)
        torch.nn.utils.clip_grad_norm_(parameters.values(), 1.0)
        optimizer.step()
        certain = torch.equal(state, torch.get_rng_state())
        if step and (certain or len(learned) == len(parameters)):
            break
    dead = [name for name in parameters if name not in learned]
    expect(not dead, f"no gradient reaches {', '.join(dead)}")


@check(MODULES - {"renderer"})
def check_gradients_match_differences(case: Case) -> None:
    """In float64, gradients agree with finite differences (torch.autograd.gradcheck).

    In evaluation and in training. Gradients that are stopped on purpose: `gradients_reach_inputs`.
    """
    small = case.with_dims(width=8, heads=2) if case.has_parameters else case
    module = small.lively().double()
    inputs = cast(inputs_of(small, SMALL), torch.float64)
    for mode in each_mode(module):
        _expect_gradients(module, inputs, mode)


def _expect_gradients(module: Any, inputs: Inputs, mode: str) -> None:
    given = {n: x for n, x in floating(inputs).items() if _is_smooth(n)}
    parameters = {f"parameter {n}": p.detach() for n, p in module.named_parameters()}
    names = [*given, *parameters]
    points = [x.detach().clone().requires_grad_() for x in (*given.values(), *parameters.values())]

    def value(*tensors: Tensor) -> Tensor:
        at = dict(zip(names, tensors, strict=True))
        changed = mapped(inputs, lambda name, tensor: at.get(name, tensor))
        own = {n.removeprefix("parameter "): x for n, x in at.items() if n.startswith("parameter ")}
        with drawn_from(0):
            return scalar(functional_call(module, own, tuple(changed.values())))

    if not value(*points).requires_grad:
        _expect_constant(value, points, mode)
        return
    try:
        gradcheck(value, points, eps=1e-6, atol=1e-5, rtol=1e-3, fast_mode=True)
    except GradcheckError as error:
        expect(False, f"in {mode}: {' '.join(str(error).split())}"[:400])


def _biases_of_layers(module: nn.Module) -> set[str]:
    """Names of the biases in layers of torch itself."""
    owners = dict(module.named_modules())
    return {
        name
        for name, _ in module.named_parameters()
        if name.endswith(".bias") and is_torchs_own(owners[name.removesuffix(".bias")])
    }


def _steepest(tensors: Iterable[Tensor]) -> float:
    """The largest number in the gradients of `tensors`."""
    slopes = [x.grad for x in tensors if x.grad is not None and x.numel()]
    return max((slope.abs().max().item() for slope in slopes), default=0.0)


def _expect_constant(value: Callable[..., Tensor], points: list[Tensor], mode: str) -> None:
    """What has no gradient at all must not change either."""
    generator = torch.Generator().manual_seed(0)
    moved = [x + 1e-3 * torch.randn(x.shape, generator=generator).to(x) for x in points]
    change = (value(*moved) - value(*points)).abs().item()
    expect(
        change == 0, f"in {mode} it changes with its inputs, by {change:.2g}, but has no gradient"
    )


def _is_smooth(name: str) -> bool:
    """Whether finite differences of an input mean something: poses must stay rigid."""
    return ".cameras." not in f".{name}." and "masks" not in name

"""Everything that is learned can be learned."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.gradcheck import GradcheckError, gradcheck
from torch.func import functional_call

from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import MODULES, PARAMETRIC, check
from qgs.testing.subjects import Sizes, inputs_of
from qgs.testing.trees import cast, floating, mapped, scalar, tracked

SMALL = Sizes(batch=1, queries=3, views=2, gaussians=1)


@check(PARAMETRIC)
def check_parameters_learn(case: Case) -> None:
    """Every trainable parameter gets a finite, non-zero gradient within two optimiser steps."""
    module = case.build().train()
    parameters = {n: p for n, p in module.named_parameters() if p.requires_grad}
    if not parameters:
        return
    optimizer = torch.optim.SGD(parameters.values(), lr=0.01)
    learned: set[str] = set()
    for step in range(2):
        optimizer.zero_grad()
        scalar(module(*tracked(inputs_of(case, seed=step)).values())).backward()
        for name, parameter in parameters.items():
            slope = parameter.grad
            finite = slope is None or bool(slope.isfinite().all())
            expect(finite, f"the gradient of `{name}` is not finite in step {step + 1}")
            if slope is not None and bool((slope != 0).any()):
                learned.add(name)
        torch.nn.utils.clip_grad_norm_(parameters.values(), 1.0)
        optimizer.step()
    dead = [name for name in parameters if name not in learned]
    expect(not dead, f"no gradient reaches {', '.join(dead)}")


@check(MODULES - {"renderer"})
def check_gradients_match_differences(case: Case) -> None:
    """In float64, gradients agree with finite differences (torch.autograd.gradcheck)."""
    small = case.with_dims(width=8, heads=2) if case.has_parameters else case
    module = small.lively().double()
    inputs = cast(inputs_of(small, SMALL), torch.float64)
    given = {n: x for n, x in floating(inputs).items() if _is_smooth(n)}
    parameters = {f"parameter {n}": p.detach() for n, p in module.named_parameters()}
    names = [*given, *parameters]
    points = [x.detach().clone().requires_grad_() for x in (*given.values(), *parameters.values())]

    def value(*tensors: Tensor) -> Tensor:
        at = dict(zip(names, tensors, strict=True))
        changed = mapped(inputs, lambda name, tensor: at.get(name, tensor))
        own = {n.removeprefix("parameter "): x for n, x in at.items() if n.startswith("parameter ")}
        return scalar(functional_call(module, own, tuple(changed.values())))

    if not value(*points).requires_grad:
        return  # nothing of it can be learned: it passes on what it is given, or is constant
    try:
        gradcheck(value, points, eps=1e-6, atol=1e-5, rtol=1e-3, fast_mode=True)
    except GradcheckError as error:
        expect(False, " ".join(str(error).split())[:400])


@check({"renderer"})
def check_render_gradients_match_differences(case: Case) -> None:
    """The gradient of an image in the Gaussians agrees with finite differences."""
    module, inputs = case.lively(), tracked(inputs_of(case, Sizes(batch=1, queries=3, views=1)))
    given = {n: x for n, x in floating(inputs).items() if n.startswith("gaussians")}
    slopes = torch.autograd.grad(_brightness(module(*inputs.values())), list(given.values()))
    for name, slope in zip(given, slopes, strict=True):
        step = 0.03 * slope / slope.norm().clamp_min(1e-12)

        def shifted(sign: int, name: str = name, step: Tensor = step) -> Tensor:
            def move(n: str, x: Tensor) -> Tensor:
                return x.detach() + sign * step if n == name else x.detach()

            return _brightness(module(*mapped(inputs, move).values()))

        measured, told = (shifted(1) - shifted(-1)) / 2, (slope * step).sum()
        close = torch.isclose(measured, told.to(measured), rtol=0.1, atol=3e-6)
        seen = f"along its gradient `{name}` changes the image by {measured:.4g}, not {told:.4g}"
        expect(bool(close), seen)


def _brightness(rendering: Any) -> Tensor:
    """A smooth number of an image."""
    y = torch.linspace(-1, 1, rendering.rgb.shape[-2], dtype=torch.float64)[:, None]
    x = torch.linspace(-1, 1, rendering.rgb.shape[-1], dtype=torch.float64)
    rgb = rendering.rgb.double().cpu()
    return (rgb * torch.cos(2 * x + y)).mean() + (rgb * torch.sin(x - 2 * y)).mean()


def _is_smooth(name: str) -> bool:
    """Whether finite differences of an input mean something: poses must stay rigid."""
    return ".cameras." not in f".{name}." and "masks" not in name

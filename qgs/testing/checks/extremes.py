"""Nothing that a scene may bring makes a NaN, in evaluation or in training."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from qgs.testing.case import Case
from qgs.testing.chance import drawn_from
from qgs.testing.faults import expect
from qgs.testing.modes import each_mode
from qgs.testing.registry import MODULES, check
from qgs.testing.subjects import (
    QUERY_INPUTS,
    Inputs,
    inputs_of,
    is_place,
    required_fields,
    tracked_inputs,
)
from qgs.testing.trees import floating, mapped, not_finite, scalar

LARGE = 1e4


@check(MODULES - {"queries"})
def check_zeros_stay_finite(case: Case) -> None:
    """Inputs of zeros give finite outputs and finite gradients."""
    _expect_finite(case, "zeros", _changed(case, lambda _, x: torch.zeros_like(x)))


@check(MODULES - {"encoder", "queries"})
def check_large_numbers_stay_finite(case: Case) -> None:
    """Inputs of some 1e4 give finite outputs and finite gradients."""

    def enlarged(name: str, x: Tensor) -> Tensor:
        return x if name.endswith(("images", "rgb", "alpha", "opacities")) else LARGE * x

    _expect_finite(case, "inputs times 1e4", _changed(case, enlarged))


@check(MODULES - {"encoder", "queries"})
def check_coincident_queries_stay_finite(case: Case) -> None:
    """Queries, anchors or Gaussians in one place give finite outputs and finite gradients."""

    def together(name: str, x: Tensor) -> Tensor:
        return x[:, :1].expand_as(x).clone()

    _expect_finite(case, "coincident queries", _changed(case, together, pictures=False))


@check({"cross_attention", "self_attention", "refinement", "head", "centers", "renderer", "losses"})
def check_points_behind_cameras_stay_finite(case: Case) -> None:
    """Points behind every camera, or in a camera's centre, give finite outputs and gradients.

    Of components that are given points: Gaussians, or fields of points that they require.
    """
    places = {name for name, spec in required_fields(case).items() if is_place(spec)}
    if not places and case.slot not in ("renderer", "losses"):
        return

    def moved(z: float) -> Callable[[str, Tensor], Tensor]:
        def move(name: str, x: Tensor) -> Tensor:
            if name.endswith("gaussians.means") or name.partition("fields.")[2] in places:
                return torch.cat([x[..., :2] * (z != 0), torch.full_like(x[..., 2:], z)], -1)
            return x

        return move

    _expect_finite(case, "points behind every camera", _changed(case, moved(-2.0)))
    _expect_finite(case, "points in the centre of a camera", _changed(case, moved(0.0)))


@check({"encoder", "cross_attention", "renderer", "losses"})
def check_duplicated_view_stays_finite(case: Case) -> None:
    """A view that is given twice gives finite outputs and finite gradients."""

    def twice(name: str, x: Tensor) -> Tensor:
        if name.startswith("memory."):
            axis = 2 if name in ("memory.keys", "memory.values") else 1
            half = x.shape[axis] // 2
            first = x.narrow(axis, 0, half)
            return torch.cat([first, first], axis)
        if name.startswith(("state", "gaussians", "prediction")) or not x.shape[1]:
            return x
        return x[:, :1].expand_as(x).clone()

    _expect_finite(case, "a duplicated view", mapped(inputs_of(case), twice))


def _changed(case: Case, change: Callable[[str, Tensor], Tensor], pictures: bool = True) -> Inputs:
    """Inputs with changed numbers: of queries and Gaussians, of `pictures`, not of cameras."""

    def visit(name: str, x: Tensor) -> Any:
        fixed = ".cameras." in f".{name}." or not x.is_floating_point() or "patch_rays" in name
        per_query = name.startswith((*QUERY_INPUTS, "gaussians", "prediction"))
        return change(name, x) if (per_query or pictures) and not fixed else x

    return mapped(inputs_of(case), visit)


def _expect_finite(case: Case, what: str, inputs: Inputs) -> None:
    module = case.lively()
    for mode in each_mode(module):
        with drawn_from(0):
            _expect_finite_pass(module, tracked_inputs(case, inputs), f"in {mode}, with {what}")


def _expect_finite_pass(module: Any, given: Inputs, where: str) -> None:
    outputs = module(*given.values())
    broken = not_finite(outputs)
    expect(not broken, f"{where}, {', '.join(broken)} is not finite")
    total = scalar(outputs)
    if not total.requires_grad:
        return
    total.backward()
    wrong = [n for n, x in floating(given).items() if _wrong(x.grad)]
    wrong += [n for n, p in module.named_parameters() if _wrong(p.grad)]
    expect(not wrong, f"{where}, the gradient of {', '.join(wrong)} is not finite")


def _wrong(slope: Tensor | None) -> bool:
    return slope is not None and not bool(slope.isfinite().all())

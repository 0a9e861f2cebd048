"""Outputs depend on what they are computed from, and gradients reach it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import check
from qgs.testing.subjects import Inputs, inputs_of, required_fields, tracked_inputs
from qgs.testing.trees import difference, floating, scalar

DRAWS = 3
"""Inputs that are tried: some hinge of a component may be shut for one of them."""

READ = {
    "cross_attention": ("state.features",),
    "self_attention": ("state.features",),
    "feed_forward": ("features",),
    "refinement": (),
    "head": ("state.features",),
    "centers": ("offsets",),
    "renderer": tuple(
        f"gaussians.{name}" for name in ("means", "scales", "quats", "opacities", "colors")
    ),
    "losses": (),
}
"""Inputs that a component of each slot reads, whatever its options."""


@check(READ)
def check_gradients_reach_inputs(case: Case) -> None:
    """What a component reads gets a gradient: the inputs of its slot and the fields it requires."""
    missing = set(_read(case))
    module, provided = case.lively(), case.component.provides(case.config)
    for inputs in _draws(case):
        outputs = module(*inputs.values())
        if case.slot == "refinement":
            outputs = {name: outputs.fields[name] for name in provided}
        missing -= _reached(scalar(outputs), inputs)
        if not missing:
            return
    expect(False, f"no gradient reaches {', '.join(sorted(missing))}")


@check({"losses"})
def check_terms_have_gradients(case: Case) -> None:
    """Every term has a gradient in the prediction or in the rendering: else it trains nothing."""
    module = case.lively()
    idle: set[str] | None = None
    for inputs in _draws(case):
        terms = module(*inputs.values())
        still = {n for n, term in terms.items() if not _reached(term, _without_target(inputs))}
        idle = still if idle is None else idle & still
    expect(not idle, f"nothing gets a gradient of the term {', '.join(sorted(idle or ()))}")


@check({"encoder"})
def check_memory_depends_on_images(case: Case) -> None:
    """Values and features of the image memory change with the images."""
    module, inputs = case.lively(), inputs_of(case)
    views, others = inputs["views"], inputs_of(case, seed=1)["views"]
    assert not difference(views.cameras, others.cameras)
    one, other = module(views), module(others)
    for name in ("values", "features"):
        changes = bool(difference(getattr(one, name), getattr(other, name)))
        expect(changes, f"`{name}` stays as it is when the images change")


def _read(case: Case) -> Iterable[str]:
    """Dotted names of the floating-point inputs that a component reads."""
    yield from READ[case.slot]
    state = "prediction.state" if case.slot == "losses" else "state"
    for name, spec in required_fields(case).items():
        if spec.dtype.is_floating_point:
            yield f"{state}.fields.{name}"
    required = case.component.requires(case.config)
    yield from (name for name in required if name.startswith(("memory.", "rendering.")))


def _draws(case: Case) -> Iterable[Inputs]:
    return (tracked_inputs(case, inputs_of(case, seed=seed)) for seed in range(DRAWS))


def _without_target(inputs: Inputs) -> dict[str, Any]:
    return {name: value for name, value in inputs.items() if name != "target"}


def _reached(total: Tensor, inputs: Inputs) -> set[str]:
    """Names of the inputs in which `total` has a gradient that is not zero."""
    if not total.requires_grad:
        return set()
    given = {name: x for name, x in floating(inputs).items() if x.requires_grad}
    slopes = torch.autograd.grad(total, list(given.values()), allow_unused=True)
    return {n for n, s in zip(given, slopes, strict=True) if s is not None and bool(s.any())}

"""Outputs depend on what they are computed from, and gradients reach it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torch import Tensor

from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import check
from qgs.testing.subjects import Inputs, inputs_of, required_fields, tracked_inputs
from qgs.testing.trees import difference, floating, scalar, slopes

DRAWS = 8
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


ITEMS = {"offsets": 2, "state": 1, "features": 1, "gaussians": 1}
"""Dimensions after that of the scenes which count queries and their Gaussians, by input."""


@check(READ)
def check_gradients_reach_inputs(case: Case) -> None:
    """What a component reads gets a gradient: the inputs of its slot and the fields it requires.
    One stopped on purpose, as of reference points, is told as an expected failure of this check and
    of `gradients_match_differences`.

    Every query and every Gaussian of an input gets one. What requires nothing and gives zeros alone
    is an ablation, and passes.
    """
    reached: dict[str, Tensor] = {}
    module, provided = case.lively(), case.component.provides(case.config)
    zeros = not case.component.requires(case.config)
    for inputs in _draws(case):
        outputs = module(*inputs.values())
        if case.slot == "refinement":
            outputs = {name: outputs.fields[name] for name in provided}
        zeros = zeros and _is_zero(outputs)
        for name, items in _reached(scalar(outputs), inputs).items():
            reached[name] = reached[name] | items if name in reached else items
        if all(name in reached and reached[name].all() for name in _read(case)):
            return
    expect(zeros, f"no gradient reaches {_without_gradient(case, reached)}")


@check({"losses"})
def check_terms_have_gradients(case: Case) -> None:
    """Every term has a gradient in the prediction or in the rendering: else it trains nothing.

    A loss that requires nothing and is zero for all that it is given, as one of weight 0, passes.
    """
    module = case.lively()
    idle: set[str] | None = None
    zeros = not case.component.requires(case.config)
    for inputs in _draws(case):
        terms = module(*inputs.values())
        zeros = zeros and _is_zero(terms)
        still = {n for n, term in terms.items() if not _reached(term, _without_target(inputs))}
        idle = still if idle is None else idle & still
    expect(
        zeros or not idle, f"nothing gets a gradient of the term {', '.join(sorted(idle or ()))}"
    )


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


def _is_zero(outputs: Any) -> bool:
    numbers = floating(outputs).values()
    return bool(numbers) and not any(x.any() for x in numbers)


def _without_gradient(case: Case, reached: dict[str, Tensor]) -> str:
    """The inputs that have no gradient, or else the queries and Gaussians of one that have none."""
    missing = sorted(name for name in _read(case) if name not in reached)
    if missing:
        return ", ".join(missing)
    name = next(n for n in _read(case) if not reached[n].all())
    indices = (~reached[name]).nonzero().squeeze(-1).tolist()
    return f"{', '.join(map(str, indices))} of {name}"


def _reached(total: Tensor, inputs: Inputs) -> dict[str, Tensor]:
    """Of the inputs in which `total` has a gradient that is not zero: which items have one."""
    return {n: _items(n, s != 0) for n, s in slopes(total, inputs).items() if bool(s.any())}


def _items(name: str, holds: Tensor) -> Tensor:
    """For which queries or Gaussians, in any scene, it `holds` of an input."""
    kept = next((dims for part, dims in ITEMS.items() if f".{part}." in f".{name}."), 0)
    shape = holds.shape[1 : 1 + kept]
    return holds.any(0).reshape(*shape, -1).any(-1)

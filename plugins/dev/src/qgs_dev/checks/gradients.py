"""Gradients reach what is read, are right, and stay finite, as outputs do, for extreme inputs."""

from collections.abc import Callable, Collection, Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from qgs.contracts import GAUSSIAN_FIELDS
from qgs_dev.case import Case
from qgs_dev.inputs import (
    FACTS,
    QUERY_INPUTS,
    Inputs,
    Sizes,
    inputs_of,
    required_fields,
    required_places,
)
from qgs_dev.modules import each_mode, seeded
from qgs_dev.vocabulary import (
    Trial,
    cast,
    difference,
    expect_finite,
    expect_none,
    expect_right_gradient,
    floating,
    gradients,
    mapped,
    scalar,
    tracked,
)

# Parameters whose gradients are compared one by one; of modules with more, all together.
SEPARATE = 200


def check_gradients_reach_inputs(case: Case) -> None:
    """A gradient reaches all that is read: the inputs of the slot and the fields it requires.
    One stopped on purpose, as of reference points, is an expected failure of this check and
    of `gradients_match_differences`.

    A component that requires nothing and gives zeros alone is an ablation, and passes.
    """
    trial = Trial(case)
    missing = {*_read(case)}
    zeros = not case.reads
    for inputs in _draws(trial):
        outputs = floating(trial(inputs))
        if case.slot == "refinement":
            outputs = {name: outputs[f"fields.{name}"] for name in case.writes}
        zeros = zeros and _are_zero(outputs)
        found = gradients(scalar(outputs), inputs)
        missing -= {name for name, gradient in found.items() if gradient.any()}
        if not missing:
            return
    if not zeros:
        expect_none(missing, "no gradient reaches it")


def _read(case: Case) -> Iterator[str]:
    """Dotted names of the floating-point inputs that a component reads."""
    yield from FACTS[case.slot]["reads"]
    state = "prediction.state" if case.slot == "losses" else "state"
    for name, spec in case.reads.items():
        # Features of Gaussians may be read rendered.
        if spec.dtype.is_floating_point and name not in GAUSSIAN_FIELDS:
            yield f"{state}.fields.{name}" if name in required_fields(case) else name


def _draws(trial: Trial) -> Iterator[Inputs]:
    # A ReLU of the component may be closed for some of them.
    return (trial.tracked(inputs_of(trial.case, seed=seed)) for seed in range(8))


def _are_zero(outputs: Any) -> bool:
    return not any(x.any() for x in floating(outputs).values())


def check_terms_have_gradients(case: Case) -> None:
    """Every term has a gradient in the prediction or in the rendering: else it trains nothing.

    A loss that requires nothing and is zero for all that it is given, as one of weight 0, passes.
    """
    trial = Trial(case)
    terms = trial()
    idle = {*terms}
    zeros = not case.reads
    for inputs in _draws(trial):
        terms = trial(inputs)
        zeros = zeros and _are_zero(terms)
        learned = [inputs["prediction"], inputs["rendering"]]
        # A term that one draw clips to zero may learn from another.
        idle = {name for name in idle if _are_zero(gradients(terms[name], learned))}
    if not zeros:
        expect_none(idle, "no gradient comes from this term")


def check_gradients_match_differences(case: Case) -> None:
    """In float64, gradients agree with finite differences (torch.autograd.gradcheck).

    In evaluation and in training. Gradients that are stopped on purpose: `gradients_reach_inputs`.
    """
    small = case.with_dims(width=8, heads=2) if case.has_parameters else case
    small = case if small.problems(small.size) else small
    # Further blocks repeat these.
    small = small.with_at_most(depth=2)
    module = small.lively().double()
    inputs = cast(inputs_of(small, Sizes(batch=1, queries=3)), torch.float64)
    # Poses must stay rigid, masks are 0 or 1, and depths are measured.
    fixed = {"cameras", "masks", "depths"}
    points = {name: x for name, x in floating(inputs).items() if fixed.isdisjoint(name.split("."))}
    parameters = dict(module.named_parameters())
    # Two passes for each of many parameters take minutes: these move together.
    together = len(parameters) > SEPARATE
    if together:
        points["parameters"] = nn.utils.parameters_to_vector(parameters.values())
    else:
        points |= {f"parameter {name}": x for name, x in parameters.items()}
    points = tracked(points)

    def value(*tensors: Tensor) -> Tensor:
        at = dict(zip(points, tensors, strict=True))
        if together:
            parts = at["parameters"].split([x.numel() for x in parameters.values()])
        else:
            parts = [at[f"parameter {name}"] for name in parameters]
        own = {n: part.view_as(x) for (n, x), part in zip(parameters.items(), parts, strict=True)}
        changed = mapped(inputs, lambda name, x: at.get(name, x))
        with seeded(0):
            return scalar(functional_call(module, own, tuple(changed.values())))

    checked: dict[str, Tensor] = {}
    tolerances = {"eps": 1e-6, "atol": 1e-5, "rtol": 1e-3, "fast_mode": True}
    for mode in each_mode(module):
        total = value(*points.values())
        if not total.requires_grad:
            # What it should have gradients in is the subject of other checks.
            continue
        found = {"value": total, **gradients(total, points)}
        # Dropout aside, both modes compute the same, and one pass of differences is enough.
        if not checked or difference(found, checked):
            checked = found
            expect_right_gradient(value, [*points.values()], f"in {mode}", **tolerances)


def check_zeros_stay_finite(case: Case) -> None:
    """Inputs of zeros give finite outputs and finite gradients."""
    _expect_all_finite(case, "zeros", lambda _, x: torch.zeros_like(x))


def check_large_numbers_stay_finite(case: Case) -> None:
    """Inputs of some 1e4 give finite outputs and finite gradients."""
    bounded = ("images", "rgb", "alpha", "opacities")
    _expect_all_finite(
        case, "inputs times 1e4", lambda name, x: x if name.endswith(bounded) else 1e4 * x
    )


def check_coincident_queries_stay_finite(case: Case) -> None:
    """Queries, anchors or Gaussians in one place give finite outputs and finite gradients."""
    of_queries = (*QUERY_INPUTS, "gaussians", "prediction")
    _expect_all_finite(
        case,
        "coincident queries",
        lambda name, x: _all_as_first(x) if name.startswith(of_queries) else x,
    )


def check_points_behind_cameras_stay_finite(case: Case) -> None:
    """Points behind every camera, or in a camera's centre, give finite outputs and gradients.

    Of components that are given points: Gaussians, or fields of points that they require.
    """
    places = required_places(case)
    if not places and case.slot not in ("renderer", "losses"):
        return
    for z, where in ((-2.0, "behind every camera"), (0.0, "in the centre of a camera")):

        def moved(name: str, x: Tensor, z: float = z) -> Tensor:
            if name.endswith("gaussians.means") or name.partition("fields.")[2] in places:
                return torch.cat([x[..., :2] * (z != 0), torch.full_like(x[..., 2:], z)], -1)
            return x

        _expect_all_finite(case, f"points {where}", moved)


def check_duplicated_view_stays_finite(case: Case) -> None:
    """A view that is given twice gives finite outputs and finite gradients."""

    def twice(name: str, x: Tensor) -> Tensor:
        if name.startswith("memory."):
            axis = 2 if name in ("memory.keys", "memory.values") else 1
            # Tokens are ordered by view: the first half are those of the first view.
            first = x.narrow(axis, 0, x.shape[axis] // 2)
            return torch.cat([first, first], axis)
        of_no_view = name.startswith(("state", "gaussians", "prediction")) or not x.shape[1]
        return x if of_no_view else _all_as_first(x)

    _expect_all_finite(case, "a duplicated view", twice, fixed=())


def _all_as_first(x: Tensor) -> Tensor:
    return x[:, :1].expand_as(x).clone()


def _expect_all_finite(
    case: Case,
    what: str,
    change: Callable[[str, Tensor], Tensor],
    fixed: Collection[str] = ("cameras", "patch_rays"),
) -> None:
    """Expect finite outputs and gradients for inputs with changed numbers, but for `fixed` ones."""

    def changed(name: str, x: Tensor) -> Tensor:
        stays = not {*fixed}.isdisjoint(name.split(".")) or not x.is_floating_point()
        return x if stays else change(name, x)

    trial = Trial(case)
    inputs = mapped(trial.inputs, changed)
    for mode in each_mode(trial.module):
        where = f"in {mode}, with {what}"
        given = trial.tracked(inputs)
        with seeded(0):
            outputs = trial(given)
        expect_finite(outputs, where)
        named = {**given, **dict(trial.module.named_parameters())}
        expect_finite(gradients(scalar(outputs), named), f"in its gradient {where}")

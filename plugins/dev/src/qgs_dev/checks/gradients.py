"""Gradients reach what is read, are right, and stay finite, as outputs do, for extreme inputs."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.gradcheck import GradcheckError, gradcheck
from torch.func import functional_call

from qgs.contracts import GAUSSIAN_FIELDS
from qgs_dev.case import Case, expect
from qgs_dev.inputs import (
    QUERY_INPUTS,
    Inputs,
    Sizes,
    inputs_of,
    is_place,
    required_fields,
    tracked_inputs,
)
from qgs_dev.modules import each_mode, seeded
from qgs_dev.registry import MODULES, check
from qgs_dev.trees import (
    cast,
    difference,
    floating,
    gradients,
    mapped,
    not_finite,
    scalar,
)

READ = {
    "cross_attention": ("state.features",),
    "self_attention": ("state.features",),
    "feed_forward": ("features",),
    "refinement": (),
    "feedback": (),
    "queries": (),
    "layer": ("state.features",),
    "head": ("state.features",),
    "centers": ("offsets",),
    "renderer": (
        *("gaussians.means", "gaussians.scales", "gaussians.quats"),
        *("gaussians.opacities", "gaussians.colors", "gaussians.sh", "gaussians.features"),
    ),
    "losses": (),
}
"""Inputs that a component of each slot reads, whatever its options."""

SEPARATE = 200
"""Parameters whose gradients are compared one by one; of modules with more, all together."""


@check(READ, variants=True)
def check_gradients_reach_inputs(case: Case) -> None:
    """What a component reads gets a gradient: the inputs of its slot and the fields it requires.
    One stopped on purpose, as of reference points, is an expected failure of this check and
    of `gradients_match_differences`.

    A component that requires nothing and gives zeros alone is an ablation, and passes.
    """
    module, missing = case.lively(), [*_read(case)]
    provided = {f"fields.{name}" for name in case.component.fields_written(case.config)}
    zeros = not case.component.fields_read(case.config)
    for inputs in _draws(case):
        outputs = floating(module(*inputs.values()))
        if case.slot == "refinement":
            outputs = {name: outputs[name] for name in provided}
        zeros = zeros and _are_zero(outputs)
        found = gradients(scalar(outputs), inputs)
        missing = [name for name in missing if name not in found or not found[name].any()]
        if not missing:
            return
    expect(zeros, f"no gradient reaches {', '.join(sorted(missing))}")


def _read(case: Case) -> Iterable[str]:
    """Dotted names of the floating-point inputs that a component reads."""
    yield from READ[case.slot]
    state = "prediction.state" if case.slot == "losses" else "state"
    fields = required_fields(case)
    for name, spec in case.component.fields_read(case.config).items():
        if spec.dtype.is_floating_point and name not in GAUSSIAN_FIELDS:  # may be read rendered
            yield f"{state}.fields.{name}" if name in fields else name


def _draws(case: Case) -> Iterable[Inputs]:
    # A ReLU of the component may be closed for some of them.
    return (tracked_inputs(case, inputs_of(case, seed=seed)) for seed in range(8))


def _are_zero(outputs: Any) -> bool:
    return not any(x.any() for x in floating(outputs).values())


@check({"losses"})
def check_terms_have_gradients(case: Case) -> None:
    """Every term has a gradient in the prediction or in the rendering: else it trains nothing.

    A loss that requires nothing and is zero for all that it is given, as one of weight 0, passes.
    """
    module = case.lively()
    zeros, idle = not case.component.fields_read(case.config), None
    for inputs in _draws(case):
        terms = module(*inputs.values())
        zeros = zeros and _are_zero(terms)
        learned = {
            name: value for name, value in inputs.items() if name not in ("target", "inputs")
        }
        flat = {n for n, x in terms.items() if _are_zero(gradients(x, learned))}
        idle = flat if idle is None else idle & flat
    expect(zeros or not idle, f"no gradient comes from the term {', '.join(sorted(idle or ()))}")


@check(MODULES - {"renderer"}, variants=True)
def check_gradients_match_differences(case: Case) -> None:
    """In float64, gradients agree with finite differences (torch.autograd.gradcheck).

    In evaluation and in training. Gradients that are stopped on purpose: `gradients_reach_inputs`.
    """
    small = case.with_dims(width=8, heads=2) if case.has_parameters else case
    small = case if small.problems(small.size) else small
    small = small.with_at_most(depth=2)  # further blocks repeat these
    module = small.lively().double()
    inputs = cast(inputs_of(small, Sizes(batch=1, queries=3)), torch.float64)
    # Poses must stay rigid, masks are 0 or 1, and depths are measured.
    fixed = {"cameras", "masks", "depths"}
    smooth = {n: x for n, x in floating(inputs).items() if not fixed & {*n.split(".")}}
    parameters = {f"parameter {n}": p for n, p in module.named_parameters()}
    if len(parameters) > SEPARATE:  # two passes for each take minutes
        parameters = {"parameters": torch.cat([p.flatten() for p in module.parameters()])}
    points = {n: x.detach().clone().requires_grad_() for n, x in (smooth | parameters).items()}

    def value(*tensors: Tensor) -> Tensor:
        at = dict(zip(points, tensors, strict=True))
        changed = mapped(inputs, lambda name, x: at.get(name, x))
        own = {n.removeprefix("parameter "): x for n, x in at.items() if n in parameters}
        if "parameters" in own:
            own = _separated(own["parameters"], module)
        with seeded(0):
            return scalar(functional_call(module, own, tuple(changed.values())))

    checked: dict[str, Tensor] = {}
    for mode in each_mode(module):
        total = value(*points.values())
        if not total.requires_grad:
            continue  # what it should have gradients in is the subject of other checks
        found = {"value": total, **gradients(total, points)}
        if checked and not difference(found, checked):
            continue  # it is the same in both modes
        checked = found
        try:
            gradcheck(value, [*points.values()], eps=1e-6, atol=1e-5, rtol=1e-3, fast_mode=True)
        except GradcheckError as error:
            expect(False, f"in {mode}: {' '.join(str(error).split())}"[:400])


def _separated(vector: Tensor, module: torch.nn.Module) -> dict[str, Tensor]:
    named = dict(module.named_parameters())
    parts = vector.split([p.numel() for p in named.values()])
    return {name: part.view_as(named[name]) for name, part in zip(named, parts, strict=True)}


@check(MODULES - {"queries"})
def check_zeros_stay_finite(case: Case) -> None:
    """Inputs of zeros give finite outputs and finite gradients."""
    _expect_finite(case, "zeros", _changed(case, lambda _, x: torch.zeros_like(x)))


@check(MODULES - {"encoder", "queries"})
def check_large_numbers_stay_finite(case: Case) -> None:
    """Inputs of some 1e4 give finite outputs and finite gradients."""

    def enlarged(name: str, x: Tensor) -> Tensor:
        return x if name.endswith(("images", "rgb", "alpha", "opacities")) else 1e4 * x

    _expect_finite(case, "inputs times 1e4", _changed(case, enlarged))


@check(MODULES - {"encoder", "queries"})
def check_coincident_queries_stay_finite(case: Case) -> None:
    """Queries, anchors or Gaussians in one place give finite outputs and finite gradients."""

    def together(name: str, x: Tensor) -> Tensor:
        per_query = name.startswith((*QUERY_INPUTS, "gaussians", "prediction"))
        return x[:, :1].expand_as(x).clone() if per_query else x

    _expect_finite(case, "coincident queries", _changed(case, together))


@check({"cross_attention", "self_attention", "refinement", "head", "centers", "renderer", "losses"})
def check_points_behind_cameras_stay_finite(case: Case) -> None:
    """Points behind every camera, or in a camera's centre, give finite outputs and gradients.

    Of components that are given points: Gaussians, or fields of points that they require.
    """
    places = {name for name, spec in required_fields(case).items() if is_place(spec)}
    if not places and case.slot not in ("renderer", "losses"):
        return
    for z, where in ((-2.0, "behind every camera"), (0.0, "in the centre of a camera")):

        def moved(name: str, x: Tensor, z: float = z) -> Tensor:
            if name.endswith("gaussians.means") or name.partition("fields.")[2] in places:
                return torch.cat([x[..., :2] * (z != 0), torch.full_like(x[..., 2:], z)], -1)
            return x

        _expect_finite(case, f"points {where}", _changed(case, moved))


@check({"encoder", "layer", "cross_attention", "feedback", "renderer", "losses"})
def check_duplicated_view_stays_finite(case: Case) -> None:
    """A view that is given twice gives finite outputs and finite gradients."""

    def twice(name: str, x: Tensor) -> Tensor:
        if name.startswith("memory."):
            axis = 2 if name in ("memory.keys", "memory.values") else 1
            first = x.narrow(axis, 0, x.shape[axis] // 2)
            return torch.cat([first, first], axis)
        if name.startswith(("state", "gaussians", "prediction")) or not x.shape[1]:
            return x
        return x[:, :1].expand_as(x).clone()

    _expect_finite(case, "a duplicated view", mapped(inputs_of(case), twice))


def _changed(case: Case, change: Callable[[str, Tensor], Tensor]) -> Inputs:
    """Inputs with other numbers, except for cameras and what is made of them."""

    def changed(name: str, x: Tensor) -> Tensor:
        fixed = {"cameras", "patch_rays"} & {*name.split(".")} or not x.is_floating_point()
        return x if fixed else change(name, x)

    return mapped(inputs_of(case), changed)


def _expect_finite(case: Case, what: str, inputs: Inputs) -> None:
    module = case.lively()
    for mode in each_mode(module):
        given, where = tracked_inputs(case, inputs), f"in {mode}, with {what}"
        with seeded(0):
            outputs = module(*given.values())
            broken = not_finite(outputs)
            expect(not broken, f"{where}, {', '.join(broken)} is not finite")
            named = {**floating(given), **dict(module.named_parameters())}
            broken = not_finite(gradients(scalar(outputs), named))
        expect(not broken, f"{where}, the gradient of {', '.join(broken)} is not finite")

"""Checks of gradients, of finite numbers and of precision.

Under autocast, geometry must stay float32, and outputs must stay close to those in float32.
"""

from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.overrides import TorchFunctionMode

from qgs.containers import map_tensors, named_tensors
from qgs.contracts import GAUSSIAN_FIELDS
from qgs.precision import at_least_float32
from qgs_dev.case import CannotCheck, Case, seeded
from qgs_dev.checks.attention import explanation
from qgs_dev.inputs import (
    FACTS,
    QUERY_INPUTS,
    Inputs,
    Sizes,
    data_file,
    inputs_of,
    required_fields,
    required_places,
)
from qgs_dev.vocabulary import (
    Trial,
    cast,
    described,
    difference,
    each_mode,
    expect,
    expect_finite,
    expect_none,
    expect_right_gradient,
    floating,
    gradients,
    leaves,
    mapped,
    scalar,
    tracked,
)

# Largest number of parameters whose gradients are compared one by one; above it, all together.
SEPARATE = 200


def check_gradients_reach_inputs(case: Case) -> None:
    """Require a gradient for each input that the slot must read and for each required field.

    Results must have a gradient with respect to these inputs. If a component stops a gradient on
    purpose, for example the gradient of reference points, list this check and
    `gradients_match_differences` as expected failures. A component for ablations, which requires no
    fields and returns only zeros, passes.
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
    """Yield the dotted names of the floating-point inputs that a component reads."""
    yield from FACTS[case.slot]["reads"]
    state = "prediction.state" if case.slot == "losses" else "state"
    for name, spec in case.reads.items():
        # Features of Gaussians may be read from their rendering.
        if spec.dtype.is_floating_point and name not in GAUSSIAN_FIELDS:
            yield f"{state}.fields.{name}" if name in required_fields(case) else name


def _draws(trial: Trial) -> Iterator[Inputs]:
    # A ReLU of the component may be closed for some draws.
    return (trial.tracked(inputs_of(trial.case, seed=seed)) for seed in range(8))


def _are_zero(outputs: Any) -> bool:
    return not any(x.any() for x in floating(outputs).values())


def check_terms_have_gradients(case: Case) -> None:
    """Require that every loss term has a gradient with respect to the prediction or the rendering.

    A loss that is always zero, such as one of weight 0, is accepted if it requires no fields.
    """
    trial = Trial(case)
    idle = {*trial()}
    zeros = not case.reads
    for inputs in _draws(trial):
        terms = trial(inputs)
        zeros = zeros and _are_zero(terms)
        learned = [inputs["prediction"], inputs["rendering"]]
        # A term that is clipped to zero for one draw may have a gradient for another.
        idle = {name for name in idle if _are_zero(gradients(terms[name], learned))}
    if not zeros:
        expect_none(idle, "no gradient comes from this term")


def check_gradients_match_differences(case: Case) -> None:
    """Require that float64 gradients agree with finite differences (torch.autograd.gradcheck).

    The check runs in evaluation and in training. If a component stops a gradient on purpose, list
    this check and `gradients_reach_inputs` as expected failures.
    """
    small = case.with_dims(width=8, heads=2) if case.has_parameters else case
    small = case if small.problems() else small
    # Further blocks would repeat the first two.
    small = small.with_at_most(depth=2)
    module = small.lively().double()
    inputs = cast(inputs_of(small, Sizes(batch=1, queries=3)), torch.float64)
    # Poses must stay rigid, masks are 0 or 1, and depths are measured.
    fixed = {"cameras", "masks", "depths"}
    if case.slot == "feedback":
        # What a round compares has no gradients.
        fixed |= {"state", "views"}
    points = {name: x for name, x in floating(inputs).items() if fixed.isdisjoint(name.split("."))}
    parameters = dict(module.named_parameters())
    # Two passes for each of many parameters would take minutes, so they move together.
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
            # Other checks test which inputs must have gradients.
            continue
        found = {"value": total, **gradients(total, points)}
        # Without dropout both modes compute the same, so one pass of differences is enough.
        if not checked or difference(found, checked):
            checked = found
            expect_right_gradient(value, [*points.values()], f"in {mode}", **tolerances)


def check_zeros_stay_finite(case: Case) -> None:
    """Require finite outputs and gradients if all inputs are zero."""
    _expect_all_finite(case, "zeros", lambda _, x: torch.zeros_like(x))


def check_large_numbers_stay_finite(case: Case) -> None:
    """Require finite outputs and gradients for inputs that are 1e4 times larger than usual."""
    bounded = ("images", "rgb", "alpha", "opacities")
    _expect_all_finite(
        case, "inputs times 1e4", lambda name, x: x if name.endswith(bounded) else 1e4 * x
    )


def check_coincident_queries_stay_finite(case: Case) -> None:
    """Require finite outputs and gradients if all queries, or all Gaussians, are the same."""
    of_queries = (*QUERY_INPUTS, "gaussians", "prediction")
    _expect_all_finite(
        case,
        "coincident queries",
        lambda name, x: _all_as_first(x) if name.startswith(of_queries) else x,
    )


def check_points_behind_cameras_stay_finite(case: Case) -> None:
    """Require finite outputs and gradients for points behind cameras or in a camera centre.

    The check applies to components with points as inputs: centres of Gaussians, or required state
    fields that hold points.
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
    """Require finite outputs and gradients if all views are the same."""

    def twice(name: str, x: Tensor) -> Tensor:
        if name.startswith("memory."):
            axis = 2 if name in ("memory.keys", "memory.values") else 1
            # Tokens are ordered by view, so the first half belongs to the first view.
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
    """Expect finite outputs and gradients after a change of all inputs.

    change: function of name and tensor that returns the changed tensor. fixed: names of inputs that
    stay the same. what: description of the change for messages.
    """

    def changed(name: str, x: Tensor) -> Tensor:
        stays = not {*fixed}.isdisjoint(name.split(".")) or not x.is_floating_point()
        return x if stays else change(name, x)

    trial = Trial(case)
    inputs = mapped(trial.inputs, changed)
    for mode in each_mode(trial.module):
        where = f"in {mode}, with {what}"
        # New ones, since a memory keeps values with their graphs.
        given = trial.tracked(inputs)
        with seeded(0):
            outputs = trial(given)
        expect_finite(outputs, where)
        named = {**given, **dict(trial.module.named_parameters())}
        expect_finite(gradients(scalar(outputs), named), f"in its gradient {where}")


ATTENTION = ("cross_attention", "self_attention")

# Name of the geometry term of attention logits; it is -inf where a token is hidden from a query.
EXPLAINED = "explain.geometry"

# Tolerances of geometry under autocast against float32; bfloat16 rounding is 4e-3.
RTOL = 1e-5
ATOL = 1e-6

# Names of inputs that are bfloat16 under autocast, and of torch functions of layers and products.
NAMES: dict[str, list[str]] = data_file("precision.toml")


def check_geometry_is_float32_under_autocast(case: Case) -> None:
    """Require that geometry is computed in float32 under bfloat16 autocast.

    Learned layers run in bfloat16. If their outputs are replayed in a float32 run, geometry must
    have the same values in both runs. Geometry includes centres of Gaussians, fields in the world
    frame, fields that a component reads and writes again, outputs of a head, the geometry term of
    attention logits, images and losses. All outputs must be finite. The check runs in training and
    in evaluation.
    """
    trial = Trial(case)
    module = trial.module
    inputs = _halved(trial.inputs)
    if case.slot == "queries":
        # The parameters of queries are not layers but geometry.
        module.requires_grad_(False)
    for mode in each_mode(module):
        where = f"in {mode} under autocast"
        with seeded(0), torch.autocast(case.device, torch.bfloat16), LearnedLayers() as layers:
            outputs = _with_explanation(trial, inputs)
        expect_finite({n: x for n, x in outputs.items() if n != EXPLAINED}, where)
        # Replayed layers give the same outputs in both precisions, so only geometry can differ.
        with seeded(0), LearnedLayers(layers.outputs) as replayed:
            exact = _with_explanation(trial, cast(inputs, torch.float32))
        geometry = tuple(FACTS[case.slot].get("geometry", ()))
        seen = {name: x for name, x in floating(outputs).items() if name.startswith(geometry)}
        for name, tensor in seen.items():
            kept = tensor.dtype == torch.float32
            expect(kept, f"{where} `{name}` is {described(tensor)}, not float32")
        # A field without a frame that is not an update of a field read before is learned.
        for name, spec in case.writes.items():
            if spec.frame == "none" and name not in case.reads:
                seen.pop(f"fields.{name}", None)
        found = difference({name: exact[name] for name in seen}, seen, RTOL, ATOL)
        if found and replayed.differs:
            raise CannotCheck("the component calls different layers in float32 and under autocast")
        expect(not found, f"{where}, compared with float32, {found}")
        if case.slot in ATTENTION:
            expect_none(layers.halved, f"converts float32 geometry to bfloat16 {where}")


def _halved(inputs: Inputs) -> Inputs:
    """Convert features to bfloat16 tensors that require gradients; leave geometry unchanged."""
    return mapped(
        inputs, lambda name, x: x.bfloat16().requires_grad_() if name in NAMES["halved"] else x
    )


def _with_explanation(trial: Trial, inputs: Inputs) -> dict[str, Any]:
    """Return the outputs by name. For attention, add the geometry term that `explain` returns."""
    outputs = leaves(trial(inputs))
    if trial.case.slot in ATTENTION:
        weights = explanation(trial.module, inputs)
        if weights is not None and weights.geometry is not None:
            outputs[EXPLAINED] = weights.geometry
    return outputs


def check_autocast_is_close(case: Case) -> None:
    """Require that outputs under bfloat16 autocast agree with float32 up to rounding.

    The mean absolute difference may be at most a tenth of the mean absolute deviation of an output.
    """
    trial = Trial(case)
    inputs = _halved(trial.inputs)
    exact = floating(trial(cast(inputs, torch.float32)))
    with torch.autocast(case.device, torch.bfloat16):
        rounded = floating(trial(inputs))
    for name, tensor in exact.items():
        off = (rounded[name].float() - tensor).abs().mean()
        # A constant output has no spread; its size counts instead.
        spread = (tensor - tensor.mean()).abs().mean().clamp_min(0.1 * tensor.abs().mean() + 1e-6)
        seen = f"under autocast `{name}` is off by {off / spread:.2g} times its spread"
        expect(off <= 0.1 * spread, seen)


def check_float64_stays_float64(case: Case) -> None:
    """Require float64 outputs for float64 parameters and inputs, in evaluation and in training."""
    trial = Trial(case)
    trial.module.double()
    for mode, outputs in trial.in_each_mode(cast(trial.inputs, torch.float64)):
        for name, tensor in floating(outputs).items():
            kept = tensor.dtype == torch.float64
            expect(kept, f"in {mode} `{name}` is {described(tensor)} for float64 inputs")


class LearnedLayers(TorchFunctionMode):
    """Torch mode that records the outputs of learned layers, or replays recorded ones.

    A product, such as `matmul`, counts as a learned layer if all its factors require gradients.
    Parameters, features, and values computed from them require gradients.
    replayed: recorded outputs, which layers return in the order of their calls; None records.
    halved: names of matrix products of geometry that autocast computed in bfloat16.
    differs: True after a layer was called whose name or shapes are not the next in `replayed`.
        From this call on, layers return what they compute.
    """

    def __init__(self, replayed: Iterable[tuple[str, Any]] | None = None) -> None:
        super().__init__()
        self.outputs: list[tuple[str, Any]] = []
        self.halved: set[str] = set()
        self.differs = False
        self._replayed = None if replayed is None else iter(replayed)

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call `func`. If it is a learned layer, record its output or replay the recorded one."""
        given = func(*args, **(kwargs or {}))
        name = getattr(func, "__name__", "")
        factors = [x for _, x in named_tensors([args, kwargs])]
        learned = [x.requires_grad for x in factors]
        product = name in NAMES["products"]
        if (product and all(learned)) or (name in NAMES["layers"] and any(learned)):
            return self._of_layer(name, given)
        exact = all(x.dtype == torch.float32 for x in factors)
        if product and exact and not any(learned) and given.dtype == torch.bfloat16:
            self.halved.add(name)
        return given

    def _of_layer(self, name: str, given: Any) -> Any:
        if self._replayed is None:
            self.outputs.append((name, map_tensors(torch.clone, given)))
        elif not self.differs:
            # Replayed layers must come in the order in which they were recorded.
            recorded, before = next(self._replayed, ("", None))
            self.differs = recorded != name or _shapes(before) != _shapes(given)
            return given if self.differs else map_tensors(at_least_float32, before)
        return given


def _shapes(value: Any) -> list[torch.Size]:
    return [tensor.shape for _, tensor in named_tensors(value)]

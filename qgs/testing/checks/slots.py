"""What only the components of one slot promise."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import torch

from qgs.contracts import Loss
from qgs.testing.case import Case
from qgs.testing.chance import drawn_from
from qgs.testing.faults import CannotCheck, expect
from qgs.testing.modes import each_mode
from qgs.testing.registry import check
from qgs.testing.subjects import inputs_of, tracked_inputs
from qgs.testing.trees import (
    described,
    difference,
    distance,
    leaves,
    mapped,
    not_finite,
    scalar,
    tracked,
)
from qgs.types import GaussianAttributes

LOGITS = (0.0, 1.0, 100.0)
"""Factors on the features that a head which has learned must turn into valid Gaussians."""


@check({"head"})
def check_head_gives_gaussians(case: Case) -> None:
    """Quaternions are unit, scales positive, opacities inside (0, 1), colours inside [0, 1].

    With initial parameters too, for ordinary features.
    """
    _expect_gaussians(case, case.build(), 1.0, "with initial parameters,")
    for factor in LOGITS:
        _expect_gaussians(case, case.lively(), factor, f"for features times {factor:g}")


def _expect_gaussians(case: Case, module: Any, factor: float, where: str) -> None:
    state = inputs_of(case)["state"]
    for mode in each_mode(module):
        with drawn_from(0), torch.no_grad():
            out = module(state.replace(factor * state.features))
        _expect_valid(out, factor > 1, f"in {mode}, {where}")


def _expect_valid(out: GaussianAttributes, saturated: bool, where: str) -> None:
    """saturated: whether opacities may have been rounded to 0 or 1."""
    length = out.quats.norm(dim=-1)
    unit = torch.allclose(length, torch.ones_like(length), atol=1e-4)
    expect(unit, f"{where} quaternions are {length.min():.4g} to {length.max():.4g} long")
    expect(bool((out.scales > 0).all()), f"{where} a scale is {out.scales.min():.4g}")
    low, high = out.opacities.min(), out.opacities.max()
    inside = bool(low >= 0) and bool(high <= 1)
    strict = inside and (saturated or (bool(low > 0) and bool(high < 1)))
    expect(strict, f"{where} opacities are {low:.4g} to {high:.4g}")
    low, high = out.colors.min(), out.colors.max()
    expect(bool(low >= 0) and bool(high <= 1), f"{where} colours are {low:.4g} to {high:.4g}")


@check({"queries"})
def check_queries_are_shared_by_scenes(case: Case) -> None:
    """Every scene starts from the same state, for any number of scenes."""
    module = case.lively()
    one = module(1)
    several = module(3)
    for scene in range(3):
        own = mapped(several, lambda _, x, scene=scene: x[scene : scene + 1])
        found = distance(one, own, 0.0, 0.0)
        expect(not found, f"scene {scene} of 3 starts otherwise than a scene alone: {found}")


@check({"queries"})
def check_queries_resize(case: Case) -> None:
    """`resized` gives what this component loads, whatever number of queries was learned.

    Checked of components whose option `count` says how many there are.
    """
    module = case.build()
    for count in (max(module.count // 2, 1), module.count + 3):
        learned = dict(_of_count(case, count).build(seed=1).state_dict())
        resized = module.resized(learned, torch.Generator().manual_seed(0))
        try:
            case.build(seed=2).load_state_dict(resized)
        except RuntimeError as error:
            expect(False, f"of {count} queries, `resized` gives what cannot be loaded: {error}")
        for name, values in learned.items():
            first = slice(min(len(values), len(resized[name]))) if values.ndim else ...
            kept = torch.equal(resized[name][first], values[first])
            expect(kept, f"of {count} queries, `resized` changes `{name}` of the first")


def _of_count(case: Case, count: int) -> Case:
    """The same component with another number of queries."""
    options = case.config.model_dump(mode="json")
    if "count" not in options:
        raise CannotCheck("no option `count` says how many queries there are")
    text = json.dumps({**options, "count": count})
    return replace(case, config=type(case.config).model_validate_json(text), state_dict=None)


@check({"supervision"})
def check_supervision_weights(case: Case) -> None:
    """Weights are of existing layers, ascending, none negative, and sum to 1."""
    weights = dict(case.build().weights())
    layers = list(weights)
    expect(layers == sorted(set(layers)), f"layers are {layers}")
    known = all(isinstance(n, int) and 1 <= n <= case.dims.depth for n in layers)
    expect(known and bool(layers), f"of {case.dims.depth} layers it supervises {layers}")
    expect(min(weights.values()) >= 0, f"weights are {weights}")
    expect(abs(sum(weights.values()) - 1) < 1e-6, f"weights sum to {sum(weights.values()):g}")


@check({"data"})
def check_scenes_repeat(case: Case) -> None:
    """A scene is the same each time: names, cameras, and images of the delivered size in [0, 1]."""
    try:
        first, second = (case.build().scenes("train")[0] for _ in range(2))
    except FileNotFoundError as error:
        raise CannotCheck(f"the data of this case is not here: {error}") from error
    expect(first.name == second.name, f"scene 0 is `{first.name}`, then `{second.name}`")
    frames = list(range(min(2, len(first))))
    images = first.images(frames)
    wanted = (len(frames), 3, *first.cameras.size)
    expect(tuple(images.shape) == wanted, f"images are {described(images)}, not {wanted}")
    low, high = images.min().item(), images.max().item()
    expect(images.dtype == torch.float32, f"images are {described(images)}, not float32")
    expect(low >= 0 and high <= 1, f"images are in [{low:.3g}, {high:.3g}]")
    found = difference(first.cameras, second.cameras)
    found = found or difference(images, second.images(frames))
    expect(not found, f"opened again, {found}")


@check({"renderer"})
def check_no_gaussians_give_the_background(case: Case) -> None:
    """Without Gaussians the image is the background, finite, with finite gradients."""
    module, inputs = case.lively(), tracked_inputs(case, inputs_of(case))
    empty = tracked(mapped(inputs["gaussians"], lambda _, x: x[:, :0]))
    colour = torch.tensor([0.1, 0.6, 0.9]).to(inputs["cameras"].c2w)
    out = module(empty, inputs["cameras"], colour)
    backdrop = colour[:, None, None].expand_as(out.rgb)
    expect(torch.allclose(out.rgb, backdrop, atol=1e-6), "the image is not the background")
    expect(not bool(out.alpha.any()), "alpha is not zero")
    expect(not bool(out.depth.any()), "depth is not zero")
    expect(not not_finite(out), "the rendering is not finite")
    total = scalar(out)
    if total.requires_grad:
        total.backward()
    given = {**leaves(empty), **leaves(inputs["cameras"])}
    broken = [n for n, x in given.items() if x.grad is not None and not x.grad.isfinite().all()]
    expect(not broken, f"the gradient of {', '.join(broken)} is not finite")


@check({"renderer"})
def check_rendering_is_over_the_background(case: Case) -> None:
    """alpha is in [0, 1], and where it is below 1 the background shows by what is missing."""
    module, inputs = case.lively(), inputs_of(case)
    black, white = (torch.full((3,), v).to(inputs["cameras"].c2w) for v in (0.0, 1.0))
    dark, light = (module(*inputs.values(), background=colour) for colour in (black, white))
    low, high = dark.alpha.min().item(), dark.alpha.max().item()
    expect(low >= 0 and high <= 1 + 1e-5, f"alpha is {low:.4g} to {high:.4g}")
    off = (light.rgb - dark.rgb - (1 - dark.alpha)).abs().max().item()
    expect(off < 1e-4, f"the background shows by up to {off:.3g} more or less than 1 - alpha")


@check({"losses"})
def check_loss_is_a_mean_over_scenes(case: Case) -> None:
    """The terms of a batch are the mean of those of its scenes."""
    module, inputs = case.lively(), inputs_of(case)
    alone = [
        module(*mapped(inputs, lambda _, x, s=s: x[s : s + 1]).values()) for s in range(2)
    ]  # fmt: skip
    mean = {name: (alone[0][name] + alone[1][name]) / 2 for name in alone[0]}
    found = distance(mean, module(*inputs.values()), 1e-4, 1e-6)
    expect(not found, f"against the mean over scenes, {found}")


@check({"losses"})
def check_renderings_as_declared(case: Case) -> None:
    """A loss needs the renderings that `renderings` declares: of each view, of all, or none."""
    module = case.lively()
    assert isinstance(module, Loss)
    inputs = inputs_of(case)
    terms = module(*inputs.values())
    for name, term in terms.items():
        expect(term.ndim == 0, f"the term `{name}` is of shape {tuple(term.shape)}, not 0-d")
    if module.renderings == "each":
        parts = [module(*_view(inputs, view).values()) for view in range(2)]
        mean = {name: (parts[0][name] + parts[1][name]) / 2 for name in parts[0]}
        found = distance(mean, terms, 1e-4, 1e-6)
        expect(not found, f"`each` is declared; against the mean over views, {found}")


def _view(inputs: dict[str, Any], view: int) -> dict[str, Any]:
    """The inputs of a loss with one of the target views."""
    rendering, target = inputs["rendering"], inputs["target"]
    seen = mapped(rendering, lambda _, x: x[:, view : view + 1])
    return {**inputs, "rendering": seen, "target": target.select([view])}

"""The objective: the weighted sum of its losses, with all target views at once or few at a time."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, TypeAlias

import pytest
import torch
from qgs_bench.memory import peak_memory
from qgs_bench.work import workload_of
from torch import Tensor, nn
from training_runs import TWO, Tiny, first_batch
from varying_head import VaryingHead

from qgs.composer import Recipe
from qgs.contracts import Loss, Outcome
from qgs.engine.training_pass import TrainingPass, measure
from qgs.losses import Mask, Opacity
from qgs.metrics.images import psnr
from qgs.types import Views, map_tensors


def test_total_is_the_weighted_sum_over_layers_and_losses(tiny: Tiny) -> None:
    recipe = tiny("tokengs")
    model, losses, batch = recipe.build_model().train(), recipe.build_losses(), first_batch(recipe)
    outcome = TrainingPass(model, losses)(batch.inputs, batch.targets)
    prediction = model(batch.inputs)
    expected = {"mse": 0.0, "ssim": 0.0, "visibility": 0.0}
    for layer, weight in ((2, 1 / 3), (4, 2 / 3)):
        rendering = model.render(prediction.layers[layer].gaussians, batch.targets.cameras)
        for loss in losses.values():
            terms = loss(prediction.layers[layer], rendering, batch.targets, batch.inputs)
            for name, term in terms.items():
                expected[name] += weight * float(term.detach())
    assert {name: float(term) for name, term in outcome.terms.items()} == pytest.approx(expected)
    assert float(outcome.total.detach()) == pytest.approx(sum(expected.values()))
    torch.testing.assert_close(
        outcome.signs["psnr"], psnr(rendering.rgb, batch.targets.images).mean().detach()
    )


@pytest.mark.parametrize("name", ["tokengs", "locus"])
def test_every_parameter_gets_a_finite_gradient(tiny: Tiny, name: str) -> None:
    recipe = tiny(name)
    objective = TrainingPass(recipe.build_model().train(), recipe.build_losses())
    batch = first_batch(recipe)
    objective(batch.inputs, batch.targets).total.backward()
    for parameter_name, parameter in objective.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert parameter.grad.isfinite().all(), parameter_name


TARGETS = 5
Setting: TypeAlias = Callable[..., tuple]
RENDERERS = ("qgs/torch", "qgs/cpu")


class Flicker(Loss):
    """How much views differ in brightness: no mean over views, and undeclared as such."""

    name: ClassVar[str] = "flicker"

    def __init__(self) -> None:
        super().__init__(Loss.Config())
        self.gain = nn.Parameter(torch.tensor(0.7))

    def term(self, prediction, rendering, target, inputs) -> dict[str, Tensor]:
        assert rendering.rgb.shape[1] == TARGETS
        brightness = rendering.rgb.mean((-3, -2, -1))
        return {"flicker": self.gain * brightness.std(1).mean() + rendering.depth.square().mean()}


class Blind(Loss):
    """Wants no rendering, and gets none, nor views at a time."""

    name: ClassVar[str] = "blind"
    renderings = "none"

    def term(self, prediction, rendering, target, inputs) -> dict[str, Tensor]:
        assert rendering.rgb.shape[1] == 0
        assert target.images.shape[1] == TARGETS
        return {"blind": prediction.state.features.square().mean()}


def every_loss(recipe: Recipe) -> dict[str, Loss]:
    extra = {
        "mask": Mask(Mask.Config()),
        "opacity": Opacity(Opacity.Config()),
        "blind": Blind(Loss.Config()),
    }
    return {**recipe.build_losses(), **extra}


def with_masks(views: Views) -> Views:
    masks = (views.images.mean(2, keepdim=True) > 0.4).float()
    return replace(views, masks=masks)


@pytest.fixture(scope="module")
def setting(tiny: Tiny) -> Setting:
    def make(renderer: str, *, dtype: torch.dtype = torch.float32) -> tuple:
        recipe = tiny("locus", f"model.renderer.type={renderer}", f"views.targets={TARGETS}")
        torch.manual_seed(0)
        batch = first_batch(recipe)
        model = recipe.build_model().train().to(dtype)
        inputs, targets = batch.inputs.to(dtype), with_masks(batch.targets).to(dtype)
        return model, every_loss(recipe), inputs, targets

    return make


def written_out(
    model: nn.Module, losses: Mapping[str, Loss], inputs: Views, targets: Views
) -> Tensor:
    """The objective as its definition reads: one graph for all layers and views."""
    prediction = model(inputs)
    total = torch.zeros(())
    for number, weight in model.supervision.weights().items():
        layer = prediction.layers[number]
        rendering = model.render(layer.gaussians, targets.cameras)
        for loss in losses.values():
            shown = rendering
            if loss.renderings == "none":
                shown = map_tensors(lambda tensor: tensor[:, :0], rendering)
            terms = loss(layer, shown, targets, inputs)
            total = total + weight * torch.stack(list(terms.values())).sum()
    return total


def gradients(module: nn.Module, total: Tensor) -> dict[str, Tensor]:
    module.zero_grad()
    total.backward()
    return {n: p.grad.clone() for n, p in module.named_parameters() if p.grad is not None}


def furthest(found: Mapping[str, Tensor], wanted: Mapping[str, Tensor]) -> float:
    """Largest difference, relative to the largest gradient."""
    assert found.keys() == wanted.keys()
    largest = max(float(g.abs().max()) for g in wanted.values())
    return max(float((found[n] - g).abs().max()) for n, g in wanted.items()) / largest


def error(objective: TrainingPass, *batch: Views) -> float:
    """How far its gradients are from those of the definition."""
    wanted = gradients(objective, written_out(objective.model, objective.losses, *batch))
    return furthest(gradients(objective, objective(*batch).total), wanted)


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("render_views", [0, 1, 2, 9])
@pytest.mark.parametrize("all_at_once", [False, True])
def test_gradients_do_not_depend_on_it(
    setting: Setting, renderer: str, render_views: int, all_at_once: bool
) -> None:
    model, losses, *batch = setting(renderer)
    if all_at_once:
        losses["flicker"] = Flicker()
    objective = TrainingPass(model, losses, render_views)
    assert error(objective, *batch) < 1e-6
    outcome = objective(*batch)
    assert float(outcome.total.detach()) == pytest.approx(float(sum(outcome.terms.values())))


class Marked(Loss):
    """The rendered features, which are to be those of the colours' weights."""

    name: ClassVar[str] = "marked"
    renderings = "each"

    def term(self, prediction, rendering, target, inputs) -> dict[str, Tensor]:
        return {"marked": (rendering.features - target.images.mean(2, True)).square().mean()}


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("all_at_once", [False, True])
def test_harmonics_and_features_get_theirs(
    setting: Setting, renderer: str, all_at_once: bool
) -> None:
    model, losses, *batch = setting(renderer)
    model.head = VaryingHead(model.head)
    losses |= {"marked": Marked(Loss.Config())} | ({"flicker": Flicker()} if all_at_once else {})
    objective = TrainingPass(model, losses, render_views=2)
    assert error(objective, *batch) < 1e-6
    found = gradients(objective, objective(*batch).total)["model.head.linear.weight"]
    assert found.unflatten(0, (-1, 28)).abs().amax((0, 2)).gt(0).all(), "all channels"


@pytest.mark.parametrize("render_views", [0, 1])
def test_gradients_of_two_passes_are_those_of_the_definition(
    tiny: Tiny, two: None, render_views: int
) -> None:
    """As one graph, in which the two passes and both comparisons stand written out."""
    factors = "alpha_weight: 0.1, depth_weight: 0.2"
    recipe = tiny("locus", *TWO, f"objective={{type: two/two_passes, {factors}}}")
    model, batch = recipe.build_model().train(), first_batch(recipe)
    step = TrainingPass(model, recipe.build_losses(), render_views, recipe.build_objective())
    total, seen = torch.zeros(()), []
    for views in ([0, 1, 3, 4], [0, 2, 4]):
        some = batch.inputs.select(views)
        total = total + written_out(model, step.losses, some, batch.targets) / 2
        seen.append(model.render(model(some).gaussians, batch.targets.cameras))
    for name, factor in (("alpha", 0.1), ("depth", 0.2)):
        one, other = (getattr(rendering, name) for rendering in seen)
        # half of the gradient that |one - other| has with nothing fixed, its value in full
        total = total + factor * (one - other).abs().mean() / 2
    wanted = gradients(step, total)
    assert furthest(gradients(step, step(batch.inputs, batch.targets).total), wanted) < 1e-5


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat needs a CUDA device")
@pytest.mark.parametrize("render_views", [1, 2])
def test_gradients_through_gsplat_do_not_depend_on_it(setting: Setting, render_views: int) -> None:
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    model, losses, *batch = setting("qgs/gsplat")
    objective = TrainingPass(model, losses, render_views).cuda()
    found = error(objective, *(views.to("cuda") for views in batch))
    assert found < 1e-5, "its kernels add in no fixed order"


def test_in_float64_they_are_the_same_numbers(setting: Setting) -> None:
    model, losses, *batch = setting("qgs/torch", dtype=torch.float64)
    assert error(TrainingPass(model, losses, 2), *batch) < 1e-13


def test_under_autocast_the_gaussians_get_the_same_gradients(setting: Setting) -> None:
    model, losses, *batch = setting("qgs/cpu")
    found: dict[int, dict[str, Tensor]] = {}
    for render_views in (0, 2):
        objective = TrainingPass(model, losses, render_views)
        seen = found[render_views] = {}

        def note(name: str, value: Mapping[str, Tensor], seen: dict = seen) -> None:
            if name.startswith("gradient"):
                seen.update({f"{name} {key}": tensor.float() for key, tensor in value.items()})

        objective.hook = note
        with torch.autocast("cpu", torch.bfloat16):
            outcome = objective(*batch)
        outcome.total.backward()
    assert len(found[0]) >= 10, "Gaussians and states of two layers"
    assert furthest(found[2], found[0]) < 1e-6


def test_a_scaled_total_scales_every_gradient(setting: Setting) -> None:
    model, losses, *batch = setting("qgs/cpu")
    objective = TrainingPass(model, losses, 2)
    whole = gradients(objective, objective(*batch).total)
    quarter = gradients(objective, objective(*batch).total / 4)
    assert furthest({n: 4 * g for n, g in quarter.items()}, whole) < 1e-6


@pytest.mark.parametrize("render_views", [0, 2])
def test_signs_are_those_of_all_views_of_the_last_layer(
    setting: Setting, render_views: int
) -> None:
    model, losses, inputs, targets = setting("qgs/cpu")
    outcome: Outcome = TrainingPass(model, losses, render_views)(inputs, targets)
    with torch.no_grad():
        rendering = model.render(model(inputs).gaussians, targets.cameras)
    background = torch.tensor(model.renderer.config.background)
    wanted = (
        psnr(rendering.rgb, targets.images).mean(),
        *measure(rendering.rgb, rendering.alpha, background),
    )
    torch.testing.assert_close(tuple(outcome.signs.values()), wanted)


def test_without_gradients_it_only_measures(setting: Setting) -> None:
    model, losses, *batch = setting("qgs/cpu")
    with torch.no_grad():
        outcome = TrainingPass(model, losses, 2)(*batch)
    assert not outcome.total.requires_grad
    assert float(outcome.total) == pytest.approx(float(sum(outcome.terms.values())))


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="reads Linux's accounts")
def test_memory_does_not_grow_with_target_views(tiny: Tiny, monkeypatch) -> None:
    # glibc gives freed buffers back, so that the resident set is what the step needs.
    monkeypatch.setenv("MALLOC_MMAP_THRESHOLD_", "65536")
    many = ("model.queries.count=512", "model.head.gaussians_per_query=64")
    large = ("data.image_size=[256, 256]", "model.encoder.patch_size=16", "training.render_views=2")
    steps = []
    for targets in (2, 16):
        recipe = tiny("tokengs", *many, *large, f"views.targets={targets}")
        peak = peak_memory(recipe, "step", workload_of(recipe), threads=1)
        steps.append(peak.peak_bytes - peak.idle_bytes)
    assert steps[1] <= 1.3 * steps[0]

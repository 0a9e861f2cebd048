"""The objective: the weighted sum of its losses, with all target views at once or few at a time."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from qgs_research.bench.run import peak_memory, workload_of
from tables import must_refuse
from torch import nn
from torch.testing import assert_close
from training_runs import TWO, batches, stream_of, tiny
from varying_head import VaryingHead

from qgs.containers import map_tensors
from qgs.contracts import Loss
from qgs.train.training_pass import DetachedLayer, TrainingPass, signs_of

TARGETS = 3


class Flicker(Loss):
    """How much views differ in brightness: no mean over views, and undeclared as such."""

    name = "flicker"

    def __init__(self, config):
        super().__init__(config)
        self.gain = nn.Parameter(torch.tensor(0.7))

    def term(self, prediction, rendering, target, inputs):
        assert rendering.rgb.shape[1] == TARGETS
        brightness = rendering.rgb.mean((-3, -2, -1))
        return {"flicker": self.gain * brightness.std(1).mean() + rendering.depth.square().mean()}


class Blind(Loss):
    """Wants no rendering, and gets none, nor views at a time."""

    name = "blind"
    renderings = "none"

    def term(self, prediction, rendering, target, inputs):
        assert rendering.rgb.shape[1] == 0
        assert target.images.shape[1] == TARGETS
        return {"blind": prediction.state.features.square().mean()}


class Marked(Loss):
    """The rendered features, which are to be those of the colours' weights."""

    name = "marked"
    renderings = "each"

    def term(self, prediction, rendering, target, inputs):
        return {"marked": (rendering.features - target.images.mean(2, True)).square().mean()}


def begun(recipe):
    """The training pass of a new model, and a batch for it."""
    (batch,) = batches(stream_of(recipe), 1, 2)
    return TrainingPass(recipe, recipe.build_model().train()), batch


def setting(renderer, *kinds, dtype=torch.float32):
    """A training pass with losses of all kinds, input views, and targets with masks."""
    recipe = tiny(
        "locus",
        "losses.mask={type: qgs/mask}",
        "losses.opacity={type: qgs/opacity}",
        f"model.renderer.type={renderer}",
        f"views.targets={TARGETS}",
    )
    step, batch = begun(recipe)
    step.model.to(dtype)
    step.losses.update({kind.name: kind(Loss.Config()) for kind in (Blind, *kinds)})
    masks = (batch.targets.images.mean(2, keepdim=True) > 0.4).float()
    return step, batch.inputs.to(dtype), batch.targets.replace(masks=masks).to(dtype)


def written_out(objective, inputs, targets):
    """The terms as their definition reads: one graph for all layers and views."""
    model = objective.model
    prediction = model(inputs)
    found = {}
    for number, weight in ((1, 1 / 3), (2, 2 / 3)):
        layer = prediction.layers[number]
        rendering = model.render(layer.gaussians, targets.cameras)
        for loss in objective.losses.values():
            shown = rendering
            if loss.renderings == "none":
                shown = map_tensors(lambda tensor: tensor[:, :0], rendering)
            for name, term in loss(layer, shown, targets, inputs).items():
                found[name] = found.get(name, 0) + weight * term
    return found


def gradients(module, total):
    module.zero_grad()
    total.backward()
    return {n: p.grad for n, p in module.named_parameters() if p.grad is not None}


def furthest(found, wanted):
    """Largest difference, relative to the largest gradient."""
    assert found.keys() == wanted.keys()
    largest = max(float(g.abs().max()) for g in wanted.values())
    return max(float((found[n] - g).abs().max()) for n, g in wanted.items()) / largest


def distance(objective, at_once, batch, terms, wanted):
    """How far gradients are off with so many views at once, where the terms are as they must be."""
    objective.render_views = at_once
    outcome = objective(*batch)
    assert_close(outcome.terms, terms)
    return furthest(gradients(objective, outcome.total), wanted)


@pytest.mark.parametrize(
    ("renderer", "dtype", "tolerance"),
    [("qgs/torch", torch.float64, 1e-13), ("qgs/cpu", torch.float32, 1e-6)],
)
def test_terms_and_gradients_do_not_depend_on_how_many_views_are_rendered_at_once(
    renderer, dtype, tolerance
):
    for all_at_once in ((), (Flicker,)):
        objective, *batch = setting(renderer, *all_at_once, Marked, dtype=dtype)
        objective.model.head = VaryingHead(objective.model.head).to(dtype)
        terms = written_out(objective, *batch)
        wanted = gradients(objective, sum(terms.values()))
        assert wanted.keys() == dict(objective.named_parameters()).keys()
        channels = wanted["model.head.linear.weight"].unflatten(0, (-1, 28))
        assert channels.abs().amax((0, 2)).gt(0).all()
        for at_once in (0, 1, 2, 9):
            off = distance(objective, at_once, batch, terms, wanted)
            assert off < tolerance, (all_at_once, at_once)


def test_two_passes_have_the_terms_and_gradients_of_the_definition():
    """As one graph, in which the two passes and both comparisons stand written out."""
    weights = "objective={alpha_weight: 0.1, depth_weight: 0.2}"
    frustum = "losses.frustum={type: globalsplat/frustum, weight: 1}"  # of each pass's own cameras
    step, batch = begun(tiny("locus", *TWO, weights, frustum))
    parts = [batch.inputs.select(views) for views in ([0, 1, 3, 4], [0, 2, 4])]
    first, second = (written_out(step, part, batch.targets) for part in parts)
    terms = {name: (first[name] + second[name]) / 2 for name in first}
    total = sum(terms.values())
    model = step.model
    seen = [model.render(model(part).gaussians, batch.targets.cameras) for part in parts]
    for name, factor in (("alpha", 0.1), ("depth", 0.2)):
        one, other = (getattr(rendering, name) for rendering in seen)
        terms[f"{name}_consistency"] = factor * (one - other).abs().mean()
        # half of the gradient that |one - other| has with nothing fixed, its value in full
        total = total + terms[f"{name}_consistency"] / 2
    wanted = gradients(step, total)
    for at_once in (0, 1):
        given = batch.inputs, batch.targets
        assert distance(step, at_once, given, terms, wanted) < 1e-5


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat needs a CUDA device")
def test_gradients_through_gsplat_do_not_depend_on_it():
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    objective, *batch = setting("qgs/gsplat")
    objective.cuda().render_views = 2
    batch = [views.to("cuda") for views in batch]
    wanted = gradients(objective, sum(written_out(objective, *batch).values()))
    found = gradients(objective, objective(*batch).total)
    assert furthest(found, wanted) < 1e-5  # its kernels add in no fixed order


def test_under_autocast_the_gaussians_get_the_same_gradients(monkeypatch):
    objective, *batch = setting("qgs/cpu")
    seen = []
    total = DetachedLayer.total

    def noting(layer):
        seen.append({name: gradient.float() for name, gradient in layer.gradients.items()})
        return total(layer)

    monkeypatch.setattr(DetachedLayer, "total", noting)
    for at_once in (0, 2):
        objective.render_views = at_once
        with torch.autocast("cpu", torch.bfloat16):
            objective(*batch)
    for whole, part in zip(seen[:2], seen[2:], strict=True):  # two layers
        assert len(whole) >= 5
        assert furthest(part, whole) < 1e-6


def test_signs_are_those_of_all_views_of_the_last_layer():
    objective, inputs, targets = setting("qgs/cpu")
    model = objective.model
    with torch.no_grad():
        rendering = model.render(model(inputs).gaussians, targets.cameras)
    wanted = signs_of(rendering, targets, torch.full((3,), 0.5))
    for at_once in (0, 2):
        objective.render_views = at_once
        assert_close(objective(inputs, targets).signs, wanted)


def test_a_term_named_as_a_number_of_a_step_is_refused(monkeypatch):
    step, inputs, targets = setting("qgs/cpu")
    outcome = step(inputs, targets)
    taken = replace(outcome, terms={"lr": outcome.total})
    monkeypatch.setattr(step.objective, "forward", lambda *given: taken)
    must_refuse("lr", step, inputs, targets)


def test_input_views_are_judged_too():
    step, batch = begun(tiny("tokengs", "training.judge_inputs=true", "losses.visibility=null"))
    inputs = batch.inputs
    targets = batch.targets.select([0])
    of_inputs, of_targets = (written_out(step, inputs, views) for views in (inputs, targets))
    wanted = {name: (2 * of_inputs[name] + term) / 3 for name, term in of_targets.items()}
    assert_close(step(inputs, targets).terms, wanted)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="reads Linux's accounts")
def test_memory_does_not_grow_with_target_views(monkeypatch):
    # glibc gives freed buffers back, so that the resident set is what the step needs.
    monkeypatch.setenv("MALLOC_MMAP_THRESHOLD_", "65536")
    large = (
        "model={queries: {count: 512}, head: {gaussians_per_query: 64}, encoder: {patch_size: 16}}",
        "data.image_size=[256, 256]",
        "training.render_views=2",
    )
    steps = []
    for targets in (2, 16):
        recipe = tiny("tokengs", *large, f"views.targets={targets}")
        peak = peak_memory(recipe, "step", workload_of(recipe), threads=1)
        steps.append(peak.peak_bytes - peak.idle_bytes)
    assert steps[1] <= 1.3 * steps[0]

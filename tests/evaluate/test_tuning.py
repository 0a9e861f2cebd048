"""Token tuning: the input views are met better, the weights stay as they are."""

import copy

import pytest
import torch
from line_scenes import judged_samples
from tables import assert_equal, assert_near, must_refuse
from training_runs import tiny

from qgs.containers import map_tensors
from qgs.evaluate.tuning import tune

LATENTS = (
    "plugins=[tokengs2026]",
    "model.encoder={type: tokengs2026/latent_bottleneck, depth: 1, blocks: [1], latents: 12, "
    "latent_depth: 1, patch_size: 8, layer_scale: 0.3}",
    "evaluation.tuning=latents",
)
MSE = ("losses.photometric.ssim_weight=0.0", "evaluation.tuning_steps=8")


def opened(*words):
    """The recipe, its model and the input views of a scene."""
    recipe = tiny(*words)
    return recipe, recipe.build_model().eval(), judged_samples(recipe)[0].inputs


@pytest.mark.parametrize(
    ("rate", "words"), [(1e-2, ["tokengs"]), (1e-2, ["locus"]), (0.1, ["tokengs", *LATENTS])]
)
def test_the_input_views_are_met_better_and_weights_are_bit_equal(rate, words):
    """And what does not change is encoded once; the losses are the recipe's, on the inputs."""
    recipe, model, inputs = opened(*words, *MSE, f"evaluation.tuning_rate={rate}")
    before = copy.deepcopy(model.state_dict())
    untuned = model(inputs).gaussians
    calls = []
    part = model.encoder.latent_blocks[0] if rate == 0.1 else model.encoder
    part.register_forward_hook(lambda *_: calls.append(1))
    gaussians, told = tune(model, inputs, recipe)
    assert len(calls) == 1
    assert_equal(model.state_dict(), before)
    assert all(weights.grad is None and weights.requires_grad for weights in model.parameters())
    assert not gaussians.means.requires_grad

    def error(gaussians):
        return float((model.render(gaussians, inputs.cameras).rgb - inputs.images).square().mean())

    assert told["loss_after"] < 0.99 * told["loss_before"]
    with torch.no_grad():
        assert_near(told["loss_before"], error(untuned), rtol=1e-6)
        assert_near(told["loss_after"], error(gaussians), rtol=1e-6)


def test_latents_are_tuned_at_their_own_rate():
    assert tiny("tokengs", *LATENTS).evaluation.rate == 1e-2


def test_every_floating_field_is_tuned_and_no_other(monkeypatch):
    recipe, model, inputs = opened("locus", "evaluation={tuning_steps: 1, tuning_rate: 1.0e-3}")
    start = model.queries.start(1)
    numbers = torch.arange(start.features.shape[1])[None]
    labelled = start.replace(fields={"stranger.label": numbers})
    monkeypatch.setattr(model.queries, "forward", lambda memory, views: labelled)
    seen = []
    predict = model.predict

    def recorded(views, memory, state, *rest):
        seen.append(map_tensors(torch.clone, state))
        return predict(views, memory, state, *rest)

    monkeypatch.setattr(model, "predict", recorded)
    tune(model, inputs, recipe)
    assert_equal(seen[0].features, start.features)
    assert not torch.equal(seen[-1].features, start.features)
    for name in ("anchor.center", "anchor.raw_radius"):
        assert not torch.equal(seen[-1][name], start[name])
    assert_equal(seen[-1]["stranger.label"], numbers)


def test_an_initial_state_of_other_scenes_is_refused():
    _, model, inputs = opened("locus")
    memory = model.encoder(inputs)
    reason = "the memory has 1 scenes, but the initial state has 2"
    must_refuse(reason, model.predict, inputs, memory, model.queries.start(2))

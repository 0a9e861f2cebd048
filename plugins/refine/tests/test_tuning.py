"""Token tuning: the input views are met better, the weights stay as they are."""

import pytest
import torch
from qgs_refine.tuning import tune, tuning_loss
from training_runs import Tiny, tiny_recipe

from qgs.composer import Recipe
from qgs.data.evaluation import evaluation_samples
from qgs.model import QueryGaussianModel
from qgs.types import QueryState, Views, map_tensors


@pytest.fixture
def tiny() -> Tiny:
    return tiny_recipe


def model_and_inputs(recipe: Recipe) -> tuple[QueryGaussianModel, Views]:
    samples = evaluation_samples(recipe.build_data(), recipe.views, recipe.evaluation)
    return recipe.build_model().eval(), samples[0].inputs


@pytest.mark.parametrize("name", ["tokengs", "locus"])
def test_the_input_views_are_met_better_and_weights_are_bit_equal(tiny: Tiny, name: str) -> None:
    recipe = tiny(name)
    model, inputs = model_and_inputs(recipe)
    before = {key: tensor.clone() for key, tensor in model.state_dict().items()}
    untuned = model(inputs)
    tuning = tune(model, inputs, tuning_loss(recipe), steps=8, rate=1e-2)
    assert len(tuning.losses) == 9
    assert tuning.losses[-1] < 0.99 * tuning.losses[0]
    for key, tensor in model.state_dict().items():
        assert torch.equal(tensor, before[key])
    assert all(parameter.grad is None for parameter in model.parameters())
    assert all(parameter.requires_grad for parameter in model.parameters())
    assert torch.equal(model(inputs).gaussians.means, untuned.gaussians.means)
    assert not tuning.prediction.gaussians.means.requires_grad


def test_the_losses_are_the_recipes_on_the_input_photos_encoded_once(tiny: Tiny) -> None:
    recipe = tiny("tokengs", "losses.photometric.ssim_weight=0.0")
    model, inputs = model_and_inputs(recipe)
    calls = []
    model.encoder.register_forward_hook(lambda *_: calls.append(1))
    tuning = tune(model, inputs, tuning_loss(recipe), steps=2, rate=1e-3)
    assert len(calls) == 1
    with pytest.raises(ValueError, match="at least one step, got 0"):
        tune(model, inputs, tuning_loss(recipe), steps=0)

    def error(gaussians) -> float:
        return float((model.render(gaussians, inputs.cameras).rgb - inputs.images).square().mean())

    with torch.no_grad():
        assert tuning.losses[0] == pytest.approx(error(model(inputs).gaussians), rel=1e-6)
        assert tuning.losses[-1] == pytest.approx(error(tuning.prediction.gaussians), rel=1e-6)


def test_every_floating_field_is_tuned_and_no_other(
    tiny: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = tiny("locus")
    model, inputs = model_and_inputs(recipe)
    start = model.queries.start(1)
    numbers = torch.arange(start.features.shape[1])[None]
    labelled = start.replace(fields={"stranger.label": numbers})
    monkeypatch.setattr(model.queries, "forward", lambda memory, views: labelled)
    seen: list[QueryState] = []
    predict = model.predict

    def recorded(views, memory, state, layers=None):
        seen.append(map_tensors(torch.clone, state))
        return predict(views, memory, state, layers)

    monkeypatch.setattr(model, "predict", recorded)
    tune(model, inputs, tuning_loss(recipe), steps=1, rate=1e-3)
    first, last = seen[0], seen[-1]
    assert torch.equal(first.features, start.features)
    assert not torch.equal(last.features, first.features)
    for name in ("anchor.center", "anchor.raw_radius"):
        assert torch.equal(first[name], start[name])
        assert not torch.equal(last[name], first[name])
    assert torch.equal(last["stranger.label"], numbers)


def test_a_forward_pass_starts_from_the_given_state(tiny: Tiny) -> None:
    model, inputs = model_and_inputs(tiny("locus"))
    start = model.queries.start(1)
    shifted = start.replace(fields={"anchor.center": start["anchor.center"] + 1})
    with torch.no_grad():
        plain, same, moved = model(inputs), model(inputs, state=start), model(inputs, state=shifted)
    assert torch.equal(plain.gaussians.means, same.gaussians.means)
    assert not torch.allclose(plain.gaussians.means, moved.gaussians.means)
    with pytest.raises(ValueError, match="the memory is of 1 scenes, the initial state of 2"):
        model(inputs, state=model.queries.start(2))


LATENTS = (
    "plugins=[tokengs2026]",
    "model.encoder={type: tokengs2026/latent_bottleneck, depth: 1, blocks: [1], latents: 12, "
    "latent_depth: 1, patch_size: 8, layer_scale: 0.3}",
)


def test_latents_are_tuned_and_nothing_else(tiny: Tiny) -> None:
    recipe = tiny("tokengs", *LATENTS, "evaluation.tuning=latents")
    assert recipe.evaluation.rate == 1e-2
    model, inputs = model_and_inputs(recipe)
    before = {key: tensor.clone() for key, tensor in model.state_dict().items()}
    calls = []
    model.encoder.latent_blocks[0].register_forward_hook(lambda *_: calls.append(1))
    tuning = tune(model, inputs, tuning_loss(recipe), 8, 0.1, "latents")
    assert len(calls) == 1
    assert tuning.losses[-1] < 0.99 * tuning.losses[0]
    assert all(torch.equal(tensor, before[key]) for key, tensor in model.state_dict().items())
    untuned = model(inputs).gaussians.means
    assert not torch.equal(tuning.prediction.gaussians.means, untuned)

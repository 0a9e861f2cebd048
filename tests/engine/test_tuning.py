"""Token tuning: the input views are met better, the weights stay as they are."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from qgs.composer import Recipe
from qgs.data.evaluation import evaluation_samples
from qgs.data.sampling import Sample
from qgs.engine.tuning import tune, tuning_loss
from qgs.losses import Photometric
from qgs.types import QueryState


def sample_of(recipe: Recipe) -> Sample:
    return evaluation_samples(recipe.build_data(), recipe.views, recipe.evaluation)[0]


@pytest.mark.parametrize("name", ["tokengs", "locus"])
def test_the_input_views_are_met_better_and_weights_are_bit_equal(
    tiny: Callable[..., Recipe], name: str
) -> None:
    recipe = tiny(name)
    model, inputs = recipe.build_model().eval(), sample_of(recipe).inputs
    before = {key: tensor.clone() for key, tensor in model.state_dict().items()}
    untuned = model(inputs)
    tuning = tune(model, inputs, tuning_loss(recipe), steps=8, rate=1e-2)
    assert len(tuning.losses) == 9
    assert tuning.losses[-1] < 0.99 * tuning.losses[0]
    for key, tensor in model.state_dict().items():
        assert torch.equal(tensor, before[key])
    assert all(parameter.grad is None for parameter in model.parameters())
    assert all(parameter.requires_grad for parameter in model.parameters())
    again = model(inputs)
    assert torch.equal(again.gaussians.means, untuned.gaussians.means)
    assert not tuning.prediction.gaussians.means.requires_grad


def test_the_losses_are_the_recipes_on_the_input_photos(tiny: Callable[..., Recipe]) -> None:
    recipe = tiny("tokengs", "losses.photometric.ssim_weight=0.0")
    model, inputs = recipe.build_model().eval(), sample_of(recipe).inputs
    tuning = tune(model, inputs, tuning_loss(recipe), steps=2, rate=1e-3)

    def error(gaussians) -> float:
        return float((model.render(gaussians, inputs.cameras).rgb - inputs.images).square().mean())

    with torch.no_grad():
        assert tuning.losses[0] == pytest.approx(error(model(inputs).gaussians), rel=1e-6)
        assert tuning.losses[-1] == pytest.approx(error(tuning.prediction.gaussians), rel=1e-6)


def test_every_floating_field_is_tuned_and_no_other(
    tiny: Callable[..., Recipe], monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = tiny("locus")
    model, inputs = recipe.build_model().eval(), sample_of(recipe).inputs
    start = model.queries(1)
    numbers = torch.arange(start.features.shape[1])[None]
    labelled = start.replace(fields={"stranger.label": numbers})
    monkeypatch.setattr(model.queries, "forward", lambda batch_size: labelled)
    seen: list[QueryState] = []
    predict = model.predict

    def recorded(memory, state, layers=None):
        seen.append(
            QueryState(state.features.clone(), {k: v.clone() for k, v in state.fields.items()})
        )
        return predict(memory, state, layers)

    monkeypatch.setattr(model, "predict", recorded)
    tune(model, inputs, tuning_loss(recipe), steps=1, rate=1e-3)
    first, last = seen[0], seen[-1]
    assert torch.equal(first.features, start.features)
    assert not torch.equal(last.features, first.features)
    for name in ("anchor.center", "anchor.raw_radius"):
        assert torch.equal(first[name], start[name])
        assert not torch.equal(last[name], first[name])
    assert torch.equal(last["stranger.label"], numbers)


def test_the_encoder_runs_once(tiny: Callable[..., Recipe]) -> None:
    recipe = tiny("tokengs")
    model, inputs = recipe.build_model().eval(), sample_of(recipe).inputs
    calls = []
    model.encoder.register_forward_hook(lambda *_: calls.append(1))
    tune(model, inputs, tuning_loss(recipe), steps=3)
    assert len(calls) == 1


def test_recipes_without_a_photometric_loss_take_the_published_one(
    tiny: Callable[..., Recipe],
) -> None:
    recipe = tiny("tokengs", "losses={look: {type: qgs/visibility}}")
    assert tuning_loss(recipe).config == Photometric.Config()


def test_no_step_is_refused(tiny: Callable[..., Recipe]) -> None:
    recipe = tiny("tokengs")
    with pytest.raises(ValueError, match="at least one step, got 0"):
        tune(recipe.build_model(), sample_of(recipe).inputs, tuning_loss(recipe), steps=0)


def test_a_forward_pass_starts_from_the_given_state(tiny: Callable[..., Recipe]) -> None:
    recipe = tiny("locus")
    model, inputs = recipe.build_model().eval(), sample_of(recipe).inputs
    start = model.queries(1)
    with torch.no_grad():
        plain, same = model(inputs), model(inputs, state=start)
        moved = model(
            inputs, state=start.replace(fields={"anchor.center": start["anchor.center"] + 1})
        )
    assert torch.equal(plain.gaussians.means, same.gaussians.means)
    assert not torch.allclose(plain.gaussians.means, moved.gaussians.means)
    with pytest.raises(ValueError, match="the memory is of 1 scenes, the initial state of 2"):
        model(inputs, state=model.queries(2))

"""The objective as the weighted sum of its losses over layers."""

from __future__ import annotations

import pytest
import torch
from training_runs import Tiny

from qgs.composer import Recipe
from qgs.data.sampling import Batch
from qgs.data.stream import training_batches
from qgs.engine.objective import Objective
from qgs.metrics.images import psnr


def first_batch(recipe: Recipe) -> Batch:
    return next(training_batches(recipe.build_data(), recipe.views, 2, seed=0))


def test_total_is_the_weighted_sum_over_layers_and_losses(tiny: Tiny) -> None:
    recipe = tiny("tokengs")
    model, losses, batch = recipe.build_model().train(), recipe.build_losses(), first_batch(recipe)
    outcome = Objective(model, losses)(batch.inputs, batch.targets)
    prediction = model(batch.inputs)
    expected = {"mse": 0.0, "ssim": 0.0, "visibility": 0.0}
    for layer, weight in ((2, 1 / 3), (4, 2 / 3)):
        rendering = model.render(prediction.layers[layer].gaussians, batch.targets.cameras)
        for loss in losses.values():
            terms = loss(prediction.layers[layer], rendering, batch.targets)
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
    objective, batch = (
        Objective(recipe.build_model().train(), recipe.build_losses()),
        first_batch(recipe),
    )
    objective(batch.inputs, batch.targets).total.backward()
    for parameter_name, parameter in objective.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert parameter.grad.isfinite().all(), parameter_name


def test_two_losses_with_one_term_are_refused(tiny: Tiny) -> None:
    recipe = tiny("tokengs", "losses.again={type: qgs/visibility}")
    batch = first_batch(recipe)
    objective = Objective(recipe.build_model().train(), recipe.build_losses())
    with pytest.raises(ValueError, match=r"losses\.again .*\['visibility'\]"):
        objective(batch.inputs, batch.targets)


def test_no_loss_at_all_is_refused(tiny: Tiny) -> None:
    with pytest.raises(ValueError, match="at least one loss"):
        Objective(tiny("tokengs").build_model("meta"), {})

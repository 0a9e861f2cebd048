"""Checks of losses, metrics and objectives."""

from typing import Any

import torch
from torch import Tensor, nn

from qgs.containers import map_tensors
from qgs.contracts import Metric, MetricInput, Outcome
from qgs.train.training_pass import RECORDED, TrainingPass
from qgs.types import LayerPrediction
from qgs_dev.case import CannotCheck, Case, seeded
from qgs_dev.checks.fields import resolved
from qgs_dev.inputs import Maker, Sizes, inputs_of, required_fields
from qgs_dev.vocabulary import (
    Trial,
    cloned,
    expect,
    expect_finite,
    expect_none,
    expect_same,
    gradients,
    masked,
    scene,
)

SIGNS = {"psnr", "alpha", "deviation"}
"""Names of the signs (warning values of training) that an objective must return."""
TAKEN = "name of another number in history.jsonl; rename the term"


def check_loss_is_a_mean_over_scenes(case: Case) -> None:
    """Require that each loss term of a batch is the mean of the term over its scenes."""
    trial = Trial(case)
    alone = [trial(scene(trial.inputs, index)) for index in range(2)]
    expect_same(_mean(*alone), trial(), "compared with the mean over scenes", 1e-4, 1e-6)


def check_masked_queries_are_not_judged(case: Case) -> None:
    """Require that queries with mask False, whose Gaussians have opacity 0, change no loss term."""
    trial = Trial(case)
    prediction = trial.inputs["prediction"]
    batch, queries = prediction.state.features.shape[:2]
    mask_BN = (torch.arange(batch * queries) % 3 != 1).view(batch, queries).to(case.device)

    def seen(given: LayerPrediction) -> Any:
        opacities = given.gaussians.opacities
        opacities = masked(opacities, mask_BN, 0 * opacities)
        gaussians = given.gaussians.replace(opacities=opacities)
        return trial(prediction=LayerPrediction(gaussians, given.state.replace(mask=mask_BN)))

    # Masked Gaussians have opacity 0 both times, so only their other numbers change.
    moved = masked(prediction, mask_BN, inputs_of(case, seed=1)["prediction"])
    where = "when masked queries and their Gaussians change"
    expect_same(seen(prediction), seen(moved), where, 1e-4, 1e-6)


def check_renderings_as_declared(case: Case) -> None:
    """Require that a loss uses renderings as its `renderings` declares.

    If `renderings` is "each", every loss term must be a mean over views. Terms must be 0-d tensors.
    The name of a term must differ from those of other numbers in history.jsonl.
    """
    trial = Trial(case)
    terms = trial()
    expect_none(terms.keys() & RECORDED, TAKEN)
    for name, term in terms.items():
        expect(term.ndim == 0, f"the term `{name}` has shape {tuple(term.shape)}, not 0-d")
    if trial.module.renderings == "each":
        rendering = trial.inputs["rendering"]
        target = trial.inputs["target"]
        alone = []
        for view in ([0], [1]):
            seen = map_tensors(lambda x, view=view: x[:, view], rendering)
            alone.append(trial(rendering=seen, target=target.select(view)))
        where = "the component declares `each`, but compared with the mean over views"
        expect_same(_mean(*alone), terms, where, 1e-4, 1e-6)


def _mean(one: dict[str, Tensor], other: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: (one[name] + other[name]) / 2 for name in one}


def check_metric_gives_its_columns(case: Case) -> None:
    """Require that a metric returns a finite value for each of its columns.

    The metric receives only the inputs that it lists in `needs`. Values must be the same in each
    call, and inputs must not change.
    """
    module = _metric(case)
    # Metrics may divide by zero for a perfect image.
    for noise in (0.0, 0.2):
        given = _metric_input(case, module, noise)
        before = cloned(given)
        values = _values(module, given)
        keys = sorted(module.columns())
        expect(sorted(values) == keys, f"its values are {sorted(values)}, its columns are {keys}")
        expect_finite(values, "as the value of a column")
        expect_same(values, _values(module, given), "a second call gives other values")
        expect_same(before, given, "the component changes its inputs")


def check_truth_scores_best(case: Case) -> None:
    """Require that a metric scores the true images at least as well as noisy ones."""
    module = _metric(case)
    true, false = (_values(module, _metric_input(case, module, noise)) for noise in (0.0, 0.2))
    for key, column in module.columns().items():
        pair = true[key].mean().item(), false[key].mean().item()
        seen = f"{column.heading} is {pair[0]:.4g} for the truth, {pair[1]:.4g} for a noisy image"
        expect(column.best(pair) == pair[0], f"{column.better} is better, but {seen}")


def _metric(case: Case) -> Metric:
    module = case.build()
    if module.unavailable:
        raise CannotCheck(module.unavailable)
    return module.eval()


def _metric_input(case: Case, module: Metric, noise: float) -> MetricInput:
    """Return inputs for a metric, with noise added to images and depth.

    Inputs that are not in the metric's `needs` are None. noise: standard deviation of the noise.
    """
    maker = Maker(case, Sizes(batch=1))
    target = maker.target()
    depth = maker.uniform(1, 2, "BV1HW")
    off = noise * maker.normal("BV3HW")
    optional = {"gaussians": maker.gaussians(), "depth": depth + off[:, :, :1], "true_depth": depth}
    return MetricInput(
        images=target.images + off,
        targets=target if "masks" in module.needs else target.replace(masks=None),
        gaussians_per_query=2,
        **{name: part if name in module.needs else None for name, part in optional.items()},
    )


def _values(module: Metric, given: MetricInput) -> dict[str, Tensor]:
    with torch.no_grad():
        values = module(given)
    return {"": values} if isinstance(values, Tensor) else dict(values)


def check_objective_gives_an_outcome(case: Case) -> None:
    """Require an Outcome whose total is the sum of its terms and depends on the model.

    The total must have a gradient for the model's parameters. An objective must have no parameters
    of its own. Terms and signs (warning values of training) must be 0-d and detached. The signs
    must be those in SIGNS.
    """
    module = case.build()
    expect(
        not isinstance(module, nn.Module),
        "the objective is an nn.Module, but must have no parameters",
    )
    # Objectives may split the views in halves: 2 is the least number, 3 and 5 are odd.
    for views in (2, 3, 5):
        where = f"with {views} input views"
        outcome, model = _outcome(case, module, views)
        kind = type(outcome).__name__
        expect(isinstance(outcome, Outcome), f"{where} it returns {kind}, not an Outcome")
        parts = {**outcome.terms, **outcome.signs}
        numbers = {"total": outcome.total, **parts}
        odd = [n for n, x in numbers.items() if not isinstance(x, Tensor) or x.ndim]
        expect_none(odd, f"not a 0-d tensor {where}")
        expect_finite(numbers, where)
        expect_none(outcome.terms.keys() & RECORDED, TAKEN)
        kept = [name for name, x in parts.items() if x.requires_grad]
        expect_none(kept, f"not detached {where}")
        expect_none(outcome.signs.keys() ^ SIGNS, f"missing or unknown sign {where}")
        total = outcome.total
        of_terms = sum(outcome.terms.values())
        expect_same(
            of_terms, total.detach(), f"{where}, compared with the sum of terms", 1e-4, 1e-6
        )
        found = gradients(total, dict(model.named_parameters()))
        reached = any(x.any() for x in found.values())
        expect(reached, f"{where} its total has no gradient in the model's parameters")


def check_objective_repeats(case: Case) -> None:
    """Require that an objective gives the same results in two calls with the same seed."""
    module = case.build()
    expect_same(rehearsed(case, module), rehearsed(case, module), "a second call differs")


def rehearsed(case: Case, module: Any) -> dict[str, Tensor]:
    """Call an objective with a small model; return total, terms and signs of its `Outcome`."""
    outcome, _ = _outcome(case, module, 3)
    return cloned({"total": outcome.total, **outcome.terms, **outcome.signs})


def _outcome(case: Case, module: Any, views: int) -> tuple[Outcome, nn.Module]:
    """Call an objective with a small model; return the outcome and the model."""
    recipe = resolved(case, required_fields(case))
    maker = Maker(case, Sizes(views=views))
    with seeded(0):
        passes = TrainingPass(recipe, recipe.build_model())
        return module.forward(maker.inputs(), maker.target(), passes), passes

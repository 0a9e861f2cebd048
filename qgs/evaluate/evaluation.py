"""Scores of a model on the test views of a recipe, beside those of two baselines.

The baselines are images that are made from the input views without a model.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import Progress

from qgs.contracts import Column, Metric, MetricInput, ViewSampler, Window
from qgs.data.samples import Sample
from qgs.domain import REMEDY, Domain, verdict
from qgs.evaluate.plan import EvaluationPlan, ViewsOf
from qgs.evaluate.protocol import protocol_of
from qgs.evaluate.results import Evaluation, SceneScore
from qgs.evaluate.tuning import tune
from qgs.metrics.baselines import BASELINES, worse_than_nearest
from qgs.metrics.dispersion import OPACITY_USED
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe
from qgs.types import Rendering
from qgs.wording import one_line

SECTIONS = ("plugins", "data", "views", "evaluation", "metrics")
"""Sections of a recipe that decide which views are scored, and how."""


def evaluate(
    model: QueryGaussianModel,
    recipe: Recipe,
    step: int | None = None,
    observe: Callable[[int, int], None] | None = None,
    views_of: ViewsOf | None = None,
    sampler: ViewSampler | None = None,
    show: Callable[[Sample, Rendering], None] | None = None,
) -> Evaluation:
    """Score `model` with the metrics of `recipe` on the recipe's test views.

    The model keeps its device and its mode. For a scene that fails, the result has the reason.
    step: optimiser steps after which the weights were saved. observe: called after each scene with
    the numbers of finished and of all scenes. views_of: returns the view settings of a sample;
    None: the recipe's. sampler: None: the recipe's. show: called with a sample and its renderings.

    Raises the errors of the data source, of `read_index` and of `Measures`, and ValueError if no
    scene could be scored.
    """
    measures = Measures(recipe)
    plan = EvaluationPlan(
        recipe.build_data(),
        recipe.views,
        recipe.evaluation,
        sampler or recipe.build_view_sampler(),
        views_of,
        # Depth maps cost as much as photos to decode.
        depths=any("true_depth" in metric.needs for metric in measures.metrics.values()),
    )
    scorer = _Scorer(model, measures, recipe, show)
    scores: list[SceneScore] = []
    missing: dict[str, str] = {}
    training = model.training
    # Components draw random numbers in training mode only.
    model.eval()
    try:
        for done, name in enumerate(plan.wanted, 1):
            try:
                scores.append(scorer.score(name, plan.samples(name)))
            except Exception as error:  # whatever a reader or model raises; other scenes go on
                missing[name] = one_line(error)
            if observe:
                observe(done, len(plan.wanted))
    finally:
        model.train(training)
    if not scores:
        name, reason = next(iter(missing.items()))
        raise ValueError(
            f"none of {len(missing)} scenes could be scored; the first, {name}: {reason}"
        )
    evaluation = Evaluation(
        protocol=protocol_of(recipe, plan.index, plan.wanted, model.renderer.followed),
        columns=measures.columns,
        scores=scores,
        gaussians=scorer.gaussians,
        missing=missing,
        incomplete=measures.incomplete(scores),
        step=step,
    )
    return replace(evaluation, remarks=_remarks(evaluation, model, recipe, scorer.seen))


def evaluate_into(
    model: QueryGaussianModel, recipe: Recipe, step: int | None, folder: Path
) -> Evaluation:
    """Evaluate `model` as `recipe` says, write the results into `folder` and print them."""
    console = Console()
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("scoring scenes", total=None)
        evaluation = evaluate(
            model,
            recipe,
            step,
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    evaluation.write(folder)
    evaluation.show(console)
    console.print(f"results are in {folder}", soft_wrap=True)
    return evaluation


def _remarks(
    evaluation: Evaluation, model: QueryGaussianModel, recipe: Recipe, seen: Domain
) -> list[str]:
    """Return remarks on test views unlike the training views, and on scores below a baseline."""
    remarks: list[str] = []
    # Of a model that was neither trained nor loaded there is nothing to say.
    if model.loaded_from or model.trained_on.values:
        remarks.append(verdict(model.trained_on, seen))
    # Where a model sees what it is judged on, a copy of it is perfect.
    if evaluation.columns and not any(score.given for score in evaluation.scores):
        own = recipe.tree["data"] == (model.recipe or {}).get("data")
        remedy = "train for longer" if own else REMEDY
        name, column = next(iter(evaluation.columns.items()))
        nearest = evaluation.mean(f"nearest_input_{name}")
        if worse := worse_than_nearest(column, evaluation.mean(f"model_{name}"), nearest, remedy):
            remarks.append(worse)
    return remarks


class Measures:
    """All metrics of a recipe, called together.

    columns: display of each value in tables, by name of the value.
    The constructor raises ValueError if two metrics have a value of the same name.
    """

    def __init__(self, recipe: Recipe) -> None:
        # eval(): layers of a learned metric may differ in training.
        self.metrics = {name: metric.eval() for name, metric in recipe.build_metrics().items()}
        self.columns: dict[str, Column] = {}
        self._owners: dict[str, Metric] = {}
        for label, metric in self.metrics.items():
            for key, column in metric.columns().items():
                name = _name(label, key)
                if name in self.columns:
                    raise ValueError(f"two metrics have a value called {name}; rename one metric")
                self.columns[name] = column
                self._owners[name] = metric

    def __call__(self, method: str, given: MetricInput) -> dict[str, float]:
        """Return the metric values of a sample by name, such as model_psnr.

        method: "model" or the name of a baseline, which is the first part of each name. Metrics
            whose input is None are left out. Raises ValueError with the name of a metric that
            fails.
        """
        values: dict[str, float] = {}
        for label, metric in self.metrics.items():
            # A baseline has no Gaussians and no depth: it has a dash in that column.
            if metric.unavailable or any(getattr(given, need) is None for need in metric.needs):
                continue
            try:
                found = metric(given)
                found = found if isinstance(found, Mapping) else {"": found}
                for key in metric.columns():
                    # float64, so that the mean adds no rounding of its own.
                    values[f"{method}_{_name(label, key)}"] = float(found[key].double().mean())
            except Exception as error:
                raise ValueError(f"metrics.{label} fails: {one_line(error)}") from error
        return values

    def incomplete(self, scores: Sequence[SceneScore]) -> dict[str, str]:
        """Return the reasons why scenes in `scores` lack values, by name of the value."""
        found: dict[str, str] = {}
        for name, metric in self._owners.items():
            if metric.unavailable:
                found[name] = metric.unavailable
            elif lacking := sum(f"model_{name}" not in score.values for score in scores):
                needs = " and ".join(metric.needs).replace("_", " ")
                found[name] = f"it needs {needs}, which {lacking} of {len(scores)} scenes lack"
        return found


def _name(metric: str, key: str) -> str:
    return f"{metric}_{key}" if key else metric


@dataclass
class _Scorer:
    """Scorer of samples.

    seen: measurements of the cameras of all samples scored so far. gaussians: largest number of
        Gaussians in a scene so far.
    """

    model: QueryGaussianModel
    measures: Measures
    recipe: Recipe
    show: Callable[[Sample, Rendering], None] | None
    seen: Domain = field(default_factory=Domain)
    gaussians: int = 0

    def __post_init__(self) -> None:
        self.device = self.model.device
        for metric in self.measures.metrics.values():
            metric.to(self.device)

    @torch.no_grad()
    def score(self, scene: str, samples: Iterable[Sample]) -> SceneScore:
        """Return the mean score of a scene over its samples.

        Raises ValueError for a score that is NaN or infinite.
        """
        found: list[dict[str, float]] = []
        views: list[Window] = []
        names: dict[int, str] = {}
        for sample in samples:
            found.append(self._values(sample))
            views.append((sample.input_frames, sample.target_frames))
            names |= sample.names
        # A value that one sample lacks would be a mean over other samples.
        shared = [key for key in found[0] if all(key in values for values in found)]
        means = {key: sum(values[key] for values in found) / len(found) for key in shared}
        return SceneScore(scene, views, means, names)

    def _values(self, sample: Sample) -> dict[str, float]:
        # Seen before the model runs: a failing scene counts among the cameras too.
        self.seen.see(sample.inputs.cameras, sample.targets.cameras)
        inputs = sample.inputs.to(self.device)
        targets = sample.targets.to(self.device)
        if self.recipe.evaluation.tuning_steps:
            gaussians, _ = tune(self.model, inputs, self.recipe)
        else:
            gaussians = self.model(inputs).gaussians
        self.gaussians = max(self.gaussians, gaussians.count)
        rendering = self.model.render(gaussians, targets.cameras)
        if self.show:
            self.show(sample, rendering)
        shown = MetricInput(
            rendering.rgb,
            targets,
            gaussians,
            self.model.head.gaussians_per_query,
            rendering.depth,
            targets.depths,
        )
        values = self.measures("model", shown)
        for name, baseline in BASELINES.items():
            values |= self.measures(name, MetricInput(baseline(inputs, targets.cameras), targets))
        values["gaussians_used"] = float((gaussians.opacities > OPACITY_USED).sum())
        # One NaN would spoil every mean over scenes.
        if broken := [name for name, value in values.items() if not math.isfinite(value)]:
            raise ValueError(f"the score {', '.join(broken)} is not finite (NaN or infinite)")
        return values

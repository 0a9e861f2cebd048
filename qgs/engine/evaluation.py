"""Judging a model on the test views of a recipe, beside two baselines that need none."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from qgs.composer import Recipe
from qgs.contracts import SceneSource
from qgs.data.evaluation import EvaluationPlan, SceneFailure, told
from qgs.data.sampling import Frames, Sample, stack_views
from qgs.engine.protocol import index_of, protocol_of
from qgs.engine.results import TUNING, Evaluation, SceneScore, column
from qgs.engine.tuning import Tuning, tune, tuning_loss
from qgs.metrics import gaussians_used, mean_colour, nearest_input, psnr, ssim, token_dispersion
from qgs.metrics.dispersion import median
from qgs.metrics.lpips import LpipsUnavailableError, load_lpips
from qgs.model import QueryGaussianModel
from qgs.types import Gaussians

SECTIONS = ("data", "views", "evaluation")
"""What of a recipe decides which views are judged."""

_NOT_ASKED = "not asked for; set evaluation.metrics=[lpips]"

Metric = Callable[[Tensor, Tensor], Tensor]
Observer = Callable[[int, int], None]
"""Told how many scenes are done, and how many there are."""


def evaluate(
    model: QueryGaussianModel,
    recipe: Recipe,
    step: int | None = None,
    batch: int = 1,
    observe: Observer | None = None,
) -> Evaluation:
    """Evaluate `model` on the test views of `recipe`, on the device where the model is.

    A scene that fails is told in the result and does not end the evaluation. Samples are decoded
    one at a time. Leaves the model in the mode it was in.

    step: optimiser steps behind the weights. batch: scenes that pass through the model together;
    tuned tokens pass alone. observe: see `Observer`.
    Raises what opening the data source or the index raises, and ValueError when no scene at all
    could be judged or `batch` is less than 1.
    """
    if batch < 1:
        raise ValueError(f"batch is how many scenes pass together, at least 1, got {batch}")
    source, index = recipe.build_data(), index_of(recipe)
    plan = EvaluationPlan(source, recipe.views, recipe.evaluation, index)
    training = model.training
    model.eval()
    try:
        judge = _Judge.of(model, recipe)
        outcomes = _observed(judge.judged(plan.samples(), batch), plan.wanted, observe)
        scores, missing = _by_scene(plan.wanted, outcomes)
        missing = [SceneFailure(f.scene, _without_folder(f.reason, recipe)) for f in missing]
    finally:
        model.train(training)
    if not scores:
        first = missing[0]
        raise ValueError(
            f"none of {len(missing)} scenes could be judged; the first, {first.scene}: "
            f"{first.reason}"
        )
    return Evaluation(
        protocol=protocol_of(recipe, index, plan.wanted),
        scores=scores,
        wanted=plan.wanted,
        gaussians=model.queries.count * model.head.gaussians_per_query,
        missing=missing,
        null=plan.null,
        unlisted=plan.unlisted,
        empty=judge.empty,
        held_out=None if index else _held_out(source, scores),
        step=step,
    )


@dataclass(frozen=True)
class _SampleScore:
    scene: str
    views: tuple[Frames, Frames]
    values: Mapping[str, float]


_Outcome = _SampleScore | SceneFailure


@dataclass(frozen=True)
class _Judge:
    """Scores samples. tuner: tunes one sample's tokens; None for none. empty: see `Evaluation`."""

    model: QueryGaussianModel
    metrics: Mapping[str, Metric]
    tuner: Callable[..., Tuning] | None
    empty: Mapping[str, str]

    @classmethod
    def of(cls, model: QueryGaussianModel, recipe: Recipe) -> _Judge:
        evaluation = recipe.evaluation
        metrics: dict[str, Metric] = {
            "psnr": psnr,
            "ssim": partial(ssim, covariance=evaluation.ssim_covariance),
        }
        empty: dict[str, str] = {}
        if "lpips" not in evaluation.metrics:
            empty["lpips"] = _NOT_ASKED
        else:
            try:
                metrics["lpips"] = load_lpips(evaluation.lpips_weights).to(_device(model))
            except LpipsUnavailableError as error:
                empty["lpips"] = str(error)
        tuner = None
        if evaluation.tuning_steps:
            tuner = partial(
                tune,
                model,
                loss=tuning_loss(recipe),
                steps=evaluation.tuning_steps,
                rate=evaluation.tuning_rate,
            )
        return cls(model, metrics, tuner, empty)

    def judged(self, samples: Iterable[Sample | SceneFailure], batch: int) -> Iterator[_Outcome]:
        """An outcome of every sample, up to `batch` with inputs of one shape at a time."""
        waiting: list[Sample] = []
        for sample in samples:
            if isinstance(sample, SceneFailure):
                yield sample
                continue
            shape = sample.inputs.images.shape
            alike = not waiting or waiting[0].inputs.images.shape == shape
            if len(waiting) == batch or not alike:
                yield from self._together(waiting)
                waiting = []
            waiting.append(sample)
        yield from self._together(waiting)

    @torch.no_grad()
    def _together(self, samples: Sequence[Sample]) -> list[_Outcome]:
        if len(samples) < 2 or self.tuner:
            return [self._alone(sample) for sample in samples]
        try:
            inputs = stack_views([sample.inputs for sample in samples]).to(_device(self.model))
            gaussians = self.model(inputs).gaussians
        except Exception:  # one of them is to blame: each again by itself, which tells whose
            return [self._alone(sample) for sample in samples]
        return [
            self._safely(sample, gaussians[place : place + 1])
            for place, sample in enumerate(samples)
        ]

    def _alone(self, sample: Sample) -> _Outcome:
        try:
            inputs = sample.inputs.to(_device(self.model))
            if self.tuner is None:
                return self._safely(sample, self.model(inputs).gaussians)
            tuning = self.tuner(inputs)
        except Exception as error:  # told, and never ends the other scenes
            return SceneFailure(sample.scene, told(error))
        before, after = TUNING
        ends = {before: tuning.losses[0], after: tuning.losses[-1]}
        return self._safely(sample, tuning.prediction.gaussians, ends)

    def _safely(
        self, sample: Sample, gaussians: Gaussians, more: Mapping[str, float] | None = None
    ) -> _Outcome:
        try:
            values = {**self._values(sample, gaussians), **(more or {})}
        except Exception as error:  # told, and never ends the other scenes
            return SceneFailure(sample.scene, told(error))
        broken = [name for name, value in values.items() if not math.isfinite(value)]
        if broken:
            return SceneFailure(sample.scene, f"{', '.join(broken)} is not finite")
        return _SampleScore(sample.scene, (sample.input_frames, sample.target_frames), values)

    def _values(self, sample: Sample, gaussians: Gaussians) -> dict[str, float]:
        """Everything measured on the Gaussians (1, G) of `sample`."""
        device = _device(self.model)
        inputs, targets = sample.inputs.to(device), sample.targets.to(device)
        images = {
            "model": self.model.render(gaussians, targets.cameras).rgb,
            "nearest_input": nearest_input(inputs, targets.cameras),
            "mean_colour": mean_colour(inputs, targets.cameras),
        }
        distances = token_dispersion(gaussians.means, self.model.head.gaussians_per_query)
        return {
            **{
                column(method, metric): float(score(rgb, targets.images).double().mean())
                for method, rgb in images.items()
                for metric, score in self.metrics.items()
            },
            "dispersion_mean": float(distances.double().mean()),
            "dispersion_median": float(median(distances)),
            "gaussians_used": float(gaussians_used(gaussians.opacities)),
        }


def _by_scene(
    wanted: Sequence[str], outcomes: Iterable[_Outcome]
) -> tuple[list[SceneScore], list[SceneFailure]]:
    """Scores and failures in the order of `wanted`; one failed sample fails its scene."""
    samples: dict[str, list[_SampleScore]] = {}
    failures: dict[str, SceneFailure] = {}
    for outcome in outcomes:
        if isinstance(outcome, SceneFailure):
            failures.setdefault(outcome.scene, outcome)
        else:
            samples.setdefault(outcome.scene, []).append(outcome)
    scores = [_merged(samples[name]) for name in wanted if name in samples and name not in failures]
    return scores, [failures[name] for name in wanted if name in failures]


def _merged(samples: Sequence[_SampleScore]) -> SceneScore:
    values = {
        name: sum(sample.values[name] for sample in samples) / len(samples)
        for name in samples[0].values
    }
    return SceneScore(samples[0].scene, [sample.views for sample in samples], values)


def _observed(
    outcomes: Iterable[_Outcome], wanted: Sequence[str], observe: Observer | None
) -> Iterator[_Outcome]:
    seen: set[str] = set()
    for outcome in outcomes:
        yield outcome
        seen.add(outcome.scene)
        if observe:
            observe(len(seen), len(wanted))


def _held_out(source: SceneSource, scores: Sequence[SceneScore]) -> tuple[int, int] | None:
    """Held-out frames that were targets, and all of them, over the scenes that were judged."""
    judged = {
        score.scene: {frame for _, targets in score.views for frame in targets} for score in scores
    }
    scenes, count, total = source.scenes("test"), 0, 0
    for place, name in enumerate(source.names("test")):
        if name in judged:
            held_out = set(scenes[place].held_out)
            count += len(judged[name] & held_out)
            total += len(held_out)
    return (count, total) if total else None


def _without_folder(reason: str, recipe: Recipe) -> str:
    """`reason` with files told below the data's folder, so that results do not depend on it."""
    path = recipe.tree["data"].get("path")
    folders = [path, str(Path(path).expanduser().resolve())] if isinstance(path, str) else []
    for folder in folders:
        reason = reason.replace(folder.rstrip("/") + "/", "")
    return reason


def _device(model: QueryGaussianModel) -> torch.device:
    return next(model.parameters()).device

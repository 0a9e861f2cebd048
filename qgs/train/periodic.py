"""Evaluations and pictures while a model trains."""

import logging
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
import torch
from accelerate import PartialState
from accelerate.utils import wait_for_everyone

from qgs.contracts.schedule import follow
from qgs.data.samples import Sample
from qgs.drawing.images import (
    Picture,
    depth_picture,
    depth_range,
    rgb_picture,
    side_by_side,
    write_png,
)
from qgs.evaluate.evaluation import Measures, evaluate
from qgs.evaluate.plan import EvaluationPlan
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe
from qgs.train.distributed import StopRequest
from qgs.train.folder import EVALUATIONS, RunFolder
from qgs.train.state import MovingAverage
from qgs.train.tracking import Trackers

SAMPLES = 4
"""Samples that are drawn, the same ones each time."""

_log = logging.getLogger(__name__)


class _StoppedError(Exception):
    """Training was asked to stop in the middle of an evaluation."""


@dataclass
class PeriodicEvaluation:
    """Scores of the model on the recipe's test views, and of its moving average where it has one.

    Appends to RUN/evaluations.jsonl and writes RUN/pictures/step-N.png; restores random states and
    the model's mode. One process evaluates and the others wait.
    """

    recipe: Recipe
    model: QueryGaussianModel
    average: MovingAverage | None
    folder: RunFolder
    trackers: Trackers

    def __post_init__(self) -> None:
        # A metric that is wrong must fail now, not after the training.
        Measures(self.recipe)

    def run(self, step: int, stop: StopRequest) -> None:
        """Evaluate after `step` optimiser steps. All processes must call this.

        stop: where it is requested, the evaluation ends between two scenes. A failing evaluation is
        logged as a warning and does not end the training.
        """
        used = [torch.cuda.current_device()] if torch.cuda.is_initialized() else []
        try:
            # An evaluation must not change what the training draws afterwards.
            with torch.random.fork_rng(used):
                if PartialState().is_main_process:
                    self._evaluate(step, stop)
        except _StoppedError:
            _log.warning("the evaluation at step %d is given up: training was asked to stop", step)
        except Exception as error:  # the run is saved, and worth more than an evaluation
            kind = type(error).__name__
            _log.warning("the evaluation at step %d failed: %s: %s", step, kind, error)
            _log.debug("where it failed", exc_info=True)
        # The others wait here, see TIMEOUT in `distributed`.
        wait_for_everyone()

    def _evaluate(self, step: int, stop: StopRequest) -> None:
        def between_scenes(done: int, wanted: int) -> None:
            if stop:
                raise _StoppedError

        judged = {"raw": self.model}
        if self.average:
            follow(self.average.modules(), step)
            judged["ema"] = self.average.module
        records: list[dict[str, Any]] = []
        told: dict[str, float] = {}
        for weights, model in judged.items():
            evaluation = evaluate(model, self.recipe, step, observe=between_scenes)
            scores = {n: score for n, score in evaluation.means().items() if score is not None}
            told |= {f"evaluation/{weights}/{name}": score for name, score in scores.items()}
            records.append(
                {
                    "step": step,
                    "weights": weights,
                    "protocol": evaluation.protocol.sha256,
                    "scenes": len(evaluation.scores),
                    "scores": scores,
                }
            )
        self.folder.append(*records, name=EVALUATIONS)
        self.trackers.tell(lambda tracker: tracker.log(told, step))
        picture = self._picture()
        write_png(picture, self.folder.path / "pictures" / f"step-{step}.png")
        self.trackers.tell(lambda tracker: tracker.picture("evaluation", picture, step))

    @torch.no_grad()
    def _picture(self) -> Picture:
        """Draw a row per sample: the first target view, its rendering and its depth."""
        recipe = self.recipe
        data = recipe.build_data()
        sampler = recipe.build_view_sampler()
        plan = EvaluationPlan(data, recipe.views, recipe.evaluation, sampler)
        self.model.eval()
        try:
            rows = [_row(self.model, sample) for sample in islice(_usable(plan), SAMPLES)]
        finally:
            self.model.train()
        return np.concatenate(rows)


def _usable(plan: EvaluationPlan) -> Iterator[Sample]:
    for name in plan.wanted:
        # A broken test scene has been reported by the scores; pictures take the next one.
        with suppress(Exception):
            yield from plan.samples(name)


def _row(model: QueryGaussianModel, sample: Sample) -> Picture:
    device = next(model.parameters()).device
    target = sample.targets.select(slice(0, 1)).to(device)
    rendering = model.render(model(sample.inputs.to(device)).gaussians, target.cameras)
    depth = depth_picture(rendering.depth[0, 0], *depth_range(rendering.depth))
    images = (target.images[0, 0], rendering.rgb[0, 0])
    return side_by_side([*map(rgb_picture, images), depth])

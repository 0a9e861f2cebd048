"""Evaluations and pictures while a model trains."""

import json
import logging
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator

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
from qgs.files import read_records, write_text
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe
from qgs.train.distributed import StopRequest
from qgs.train.parameters import MovingAverage
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

    latest: the step of the latest evaluation of this session.
    """

    accelerator: Accelerator
    recipe: Recipe
    model: QueryGaussianModel
    average: MovingAverage | None
    folder: Path
    trackers: Trackers
    latest: int | None = None

    def __post_init__(self) -> None:
        self.stop = StopRequest()
        # A metric that is wrong must fail now, not after the training.
        Measures(self.recipe)

    def run(self, step: int, stop: StopRequest) -> None:
        """Evaluate after `step` optimiser steps. All processes must call this.

        stop: where it is requested, the evaluation ends between two scenes. A failing evaluation is
        logged as a warning and does not end the training.
        """
        self.latest = step
        self.stop = stop
        device = self.accelerator.device
        try:
            # An evaluation must not change what the training draws afterwards.
            with torch.random.fork_rng([device] if device.type == "cuda" else []):
                if self.accelerator.is_main_process:
                    self._evaluate(step)
        except _StoppedError:
            _log.warning("the evaluation at step %d is given up: training was asked to stop", step)
        except Exception as error:  # the run is saved, and worth more than an evaluation
            kind = type(error).__name__
            _log.warning("the evaluation at step %d failed: %s: %s", step, kind, error)
            _log.debug("where it failed", exc_info=True)
        # The others wait here, see TIMEOUT in `distributed`.
        self.accelerator.wait_for_everyone()

    def _evaluate(self, step: int) -> None:
        records = [self._record("raw", step)]
        if self.average:
            # The average comes second: it is applied to the weights for as long as that takes.
            with self.average.applied():
                records.append(self._record("ema", step))
        place = self.folder / "evaluations.jsonl"
        # A resumed run evaluates again what lies after its last save.
        kept = [record for record in read_records(place) if record["step"] < step]
        write_text(place, "".join(json.dumps(record) + "\n" for record in (*kept, *records)))
        scores = {
            f"evaluation/{record['weights']}/{name}": score
            for record in records
            for name, score in record["scores"].items()
        }
        self.trackers.tell(lambda tracker: tracker.log(scores, step))
        picture = self._picture()
        write_png(picture, self.folder / "pictures" / f"step-{step}.png")
        self.trackers.tell(lambda tracker: tracker.picture("evaluation", picture, step))

    def _between_scenes(self, done: int, wanted: int) -> None:
        if self.stop:
            raise _StoppedError

    def _record(self, weights: str, step: int) -> dict[str, Any]:
        evaluation = evaluate(self.model, self.recipe, step, observe=self._between_scenes)
        return {
            "step": step,
            "weights": weights,
            "protocol": evaluation.protocol.sha256,
            "scenes": len(evaluation.scores),
            "scores": {n: score for n, score in evaluation.means().items() if score is not None},
        }

    @torch.no_grad()
    def _picture(self) -> Picture:
        """Draw a row per sample: the first target view, its rendering and its depth."""
        recipe = self.recipe
        plan = EvaluationPlan(
            recipe.build_data(),
            recipe.views,
            recipe.evaluation,
            recipe.build_view_sampler(),
        )
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

"""Evaluations and pictures while a model trains."""

import logging
from dataclasses import dataclass
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
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe
from qgs.train.distributed import StopRequest
from qgs.train.folder import EVALUATIONS, RunFolder
from qgs.train.state import MovingAverage
from qgs.train.tracking import Trackers
from qgs.types import Rendering

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

        rows: list[Picture] = []

        def draw(sample: Sample, rendering: Rendering) -> None:
            if len(rows) < SAMPLES:
                rows.append(_row(sample, rendering))

        judged = {"raw": self.model}
        if self.average:
            follow(self.average.modules(), step)
            judged["ema"] = self.average.module
        records: list[dict[str, Any]] = []
        told: dict[str, float] = {}
        for weights, model in judged.items():
            show = draw if model is self.model else None
            evaluation = evaluate(model, self.recipe, step, observe=between_scenes, show=show)
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
        picture = np.concatenate(rows)
        write_png(picture, self.folder.path / "pictures" / f"step-{step}.png")
        self.trackers.tell(lambda tracker: tracker.picture("evaluation", picture, step))


def _row(sample: Sample, rendering: Rendering) -> Picture:
    """Draw a sample: the first target view, its rendering and its depth."""
    depth = rendering.depth[0, 0]
    images = (sample.targets.images[0, 0], rendering.rgb[0, 0])
    return side_by_side([*map(rgb_picture, images), depth_picture(depth, *depth_range(depth))])

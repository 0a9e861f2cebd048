"""Evaluations and pictures during training."""

from typing import Any

import numpy as np

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
from qgs.evaluate.evaluation import evaluate
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe
from qgs.train.distributed import StopRequest
from qgs.train.folder import EVALUATIONS, RunFolder
from qgs.train.state import MovingAverage
from qgs.train.tracking import Trackers
from qgs.types import Rendering

SAMPLES = 4
"""Number of samples in each picture; all pictures of a run show the same samples."""


def judge(
    recipe: Recipe,
    model: QueryGaussianModel,
    average: MovingAverage | None,
    step: int,
    folder: RunFolder,
    trackers: Trackers,
    stop: StopRequest,
) -> None:
    """Score the model, and its moving average if it has one, on the recipe's test views.

    Appends to RUN/evaluations.jsonl and writes RUN/pictures/step-N.png. Training or evaluation mode
    of the model is restored. Raises InterruptedError after a scene if a stop is requested, and the
    errors of `evaluate`. step: optimiser steps so far. average: None if there is none.
    """

    def between_scenes(done: int, wanted: int) -> None:
        if stop:
            raise InterruptedError("evaluation ends early, because a signal asked training to stop")

    rows: list[Picture] = []

    def draw(sample: Sample, rendering: Rendering) -> None:
        if len(rows) < SAMPLES:
            rows.append(_row(sample, rendering))

    judged = {"raw": model}
    if average:
        follow(average.modules(), step)
        judged["ema"] = average.module
    records: list[dict[str, Any]] = []
    told: dict[str, float] = {}
    for weights, one in judged.items():
        show = draw if one is model else None
        evaluation = evaluate(one, recipe, step, observe=between_scenes, show=show)
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
    folder.append(*records, name=EVALUATIONS)
    trackers.tell(lambda tracker: tracker.log(told, step))
    picture = np.concatenate(rows)
    write_png(picture, folder.path / "pictures" / f"step-{step}.png")
    trackers.tell(lambda tracker: tracker.picture("evaluation", picture, step))


def _row(sample: Sample, rendering: Rendering) -> Picture:
    """Return a picture of the first target view, its rendering and its depth, side by side."""
    depth = rendering.depth[0, 0]
    images = (sample.targets.images[0, 0], rendering.rgb[0, 0])
    return side_by_side([*map(rgb_picture, images), depth_picture(depth, *depth_range(depth))])

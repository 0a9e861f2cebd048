"""Held-out views: the model beside two baselines that need none."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from qgs.composer import Recipe
from qgs.contracts import Scene
from qgs.data.loader import evaluation_samples
from qgs.data.sampling import Sample
from qgs.io.atomic import write_text
from qgs.metrics import mean_colour, nearest_input, psnr, spread, ssim, token_dispersion
from qgs.metrics.dispersion import median
from qgs.model import QueryGaussianModel

METHODS = ("model", "nearest_input", "mean_colour")

SECTIONS = ("data", "views", "evaluation")
"""What of a recipe decides which views are judged."""


@dataclass(frozen=True)
class Row:
    """One sample of one scene. psnr, ssim: per method, means over the sample's target views.

    dispersion_mean, dispersion_median: over Gaussians, of the distance to their token's centroid,
    world units.
    """

    scene: str
    input_frames: tuple[int, ...]
    target_frames: tuple[int, ...]
    psnr: Mapping[str, float]
    ssim: Mapping[str, float]
    dispersion_mean: float
    dispersion_median: float


@dataclass(frozen=True)
class Evaluation:
    """All rows and what they amount to; the same weights and recipe give the same numbers.

    held_out: how many held-out frames were judged, and how many there are; None where the test
    scenes hold none out. settings: the recipe's SECTIONS. step: optimiser steps behind the weights.
    """

    rows: Sequence[Row]
    gaussians: int
    held_out: tuple[int, int] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    step: int | None = None

    def mean(self, metric: str, method: str = "model") -> float:
        """Mean over samples of `metric` ("psnr" or "ssim") of one of METHODS.

        A sample's value is the mean over its target views, so samples weigh alike, however many
        views they have.
        """
        return sum(getattr(row, metric)[method] for row in self.rows) / len(self.rows)

    def summary(self) -> dict:
        """Means over samples, and mean, variance and median of the dispersion over samples."""
        dispersions = {
            "mean": asdict(spread(torch.tensor([row.dispersion_mean for row in self.rows]))),
            "median": asdict(spread(torch.tensor([row.dispersion_median for row in self.rows]))),
        }
        return {
            "step": self.step,
            "samples": len(self.rows),
            "scenes": len({row.scene for row in self.rows}),
            "gaussians": self.gaussians,
            **{m: {k: self.mean(k, m) for k in ("psnr", "ssim")} for m in METHODS},
            "dispersion_over_gaussians": dispersions,
            "held_out_frames": self.held_out,
            "settings": self.settings,
        }

    def write(self, folder: str | Path) -> None:
        """Write samples.csv and summary.json into `folder`, each whole or not at all."""
        write_text(Path(folder) / "samples.csv", self._csv())
        write_text(Path(folder) / "summary.json", json.dumps(self.summary(), indent=2) + "\n")

    def show(self, console: Console) -> None:
        """Print the table that a person compares by."""
        table = Table(title=f"{len(self.rows)} samples of unseen views")
        table.add_column("")
        table.add_column("PSNR", justify="right")
        table.add_column("SSIM", justify="right")
        for method in METHODS:
            scores = f"{self.mean('psnr', method):.2f}", f"{self.mean('ssim', method):.3f}"
            table.add_row(method.replace("_", " "), *scores)
        console.print(table)
        if self.held_out:
            console.print("judged on {} of {} held-out frames".format(*self.held_out))
        dispersions = self.summary()["dispersion_over_gaussians"]
        console.print(
            f"{self.gaussians} Gaussians; token dispersion over Gaussians: "
            f"mean {dispersions['mean']['mean']:.4f}, median {dispersions['median']['median']:.4f}"
        )

    def _csv(self) -> str:
        text = io.StringIO()
        scores = [f"{method}_{metric}" for method in METHODS for metric in ("psnr", "ssim")]
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(
            [
                "scene",
                "input_frames",
                "target_frames",
                *scores,
                "dispersion_mean",
                "dispersion_median",
            ]
        )
        for row in self.rows:
            values = [v for m in METHODS for v in (row.psnr[m], row.ssim[m])]
            frames = [" ".join(map(str, f)) for f in (row.input_frames, row.target_frames)]
            writer.writerow(
                [row.scene, *frames, *values, row.dispersion_mean, row.dispersion_median]
            )
        return text.getvalue()


@torch.no_grad()
def evaluate(model: QueryGaussianModel, recipe: Recipe, step: int | None = None) -> Evaluation:
    """Evaluate `model` on the test views of `recipe`, on the device where the model is.

    Leaves the model in the mode it was in. step: optimiser steps behind the weights.
    Raises what the data source raises, and ValueError when it has no test sample.
    """
    training = model.training
    model.eval()
    try:
        source = recipe.build_data()
        samples = evaluation_samples(source, recipe.views, recipe.evaluation)
        rows = [_row(model, sample) for sample in samples]
    finally:
        model.train(training)
    if not rows:
        raise ValueError("the data has no test scene to evaluate on; check `data` and `evaluation`")
    return Evaluation(
        rows,
        model.queries.count * model.head.gaussians_per_query,
        _held_out(source.scenes("test"), rows),
        {name: recipe.tree[name] for name in SECTIONS if name in recipe.tree},
        step,
    )


def _held_out(scenes: Sequence[Scene], rows: Sequence[Row]) -> tuple[int, int] | None:
    """Held-out frames that were targets, and all of them, over the scenes that were judged."""
    judged: dict[str, set[int]] = {}
    for row in rows:
        judged.setdefault(row.scene, set()).update(row.target_frames)
    count = total = 0
    for scene in islice(scenes, len(judged)):
        count += len(judged.get(scene.name, set()) & set(scene.held_out))
        total += len(scene.held_out)
    return (count, total) if total else None


def _row(model: QueryGaussianModel, sample: Sample) -> Row:
    device = next(model.parameters()).device
    inputs, targets = sample.inputs.to(device), sample.targets.to(device)
    gaussians = model(inputs).gaussians
    images = {
        "model": model.render(gaussians, targets.cameras).rgb,
        "nearest_input": nearest_input(inputs, targets.cameras),
        "mean_colour": mean_colour(inputs, targets.cameras),
    }
    distances = token_dispersion(gaussians.means, model.head.gaussians_per_query)

    def scores(metric) -> dict[str, float]:
        return {name: float(metric(rgb, targets.images).mean()) for name, rgb in images.items()}

    return Row(
        scene=sample.scene,
        input_frames=tuple(sample.input_frames),
        target_frames=tuple(sample.target_frames),
        psnr=scores(psnr),
        ssim=scores(ssim),
        dispersion_mean=float(distances.mean()),
        dispersion_median=float(median(distances)),
    )

"""Evaluation: the same twice, and equal to the metrics it is made of."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from rich.console import Console

from qgs.composer import Recipe
from qgs.data.loader import evaluation_samples
from qgs.engine import evaluate
from qgs.metrics import mean_colour, nearest_input, psnr, ssim, token_dispersion


def test_twice_gives_the_same_files(tiny: Callable[..., Recipe], tmp_path: Path) -> None:
    recipe = tiny("locus")
    for name in ("a", "b"):
        evaluate(recipe.build_model(), recipe).write(tmp_path / name)
    for file in ("summary.json", "samples.csv"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == [
        "samples.csv",
        "summary.json",
    ]


def test_rows_hold_the_metrics_of_model_and_baselines(
    tiny: Callable[..., Recipe], tmp_path: Path
) -> None:
    recipe = tiny("tokengs")
    model = recipe.build_model().eval()
    evaluation = evaluate(model, recipe)
    sample = evaluation_samples(recipe.build_data(), recipe.views, recipe.evaluation)[1]
    with torch.no_grad():
        gaussians = model(sample.inputs).gaussians
        rgb = model.render(gaussians, sample.targets.cameras).rgb
    images = {
        "model": rgb,
        "nearest_input": nearest_input(sample.inputs, sample.targets.cameras),
        "mean_colour": mean_colour(sample.inputs, sample.targets.cameras),
    }
    row = evaluation.rows[1]
    truth = sample.targets.images
    assert row.psnr == pytest.approx({k: float(psnr(v, truth).mean()) for k, v in images.items()})
    assert row.ssim == pytest.approx({k: float(ssim(v, truth).mean()) for k, v in images.items()})
    assert row.dispersion_mean == pytest.approx(float(token_dispersion(gaussians.means, 4).mean()))

    evaluation.write(tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    rows = list(csv.DictReader((tmp_path / "samples.csv").open()))
    assert summary["samples"] == len(rows) == 2
    assert summary["gaussians"] == gaussians.count
    for method in images:
        mean = sum(float(r[f"{method}_psnr"]) for r in rows) / len(rows)
        assert summary[method]["psnr"] == pytest.approx(mean)


def test_the_mode_of_the_model_is_left_alone(tiny: Callable[..., Recipe]) -> None:
    recipe = tiny("tokengs")
    model = recipe.build_model().train()
    evaluate(model, recipe)
    assert model.training


def test_the_table_shows_all_three(tiny: Callable[..., Recipe]) -> None:
    recipe = tiny("tokengs")
    console = Console(record=True, width=100, quiet=False, file=open("/dev/null", "w"))  # noqa: SIM115
    evaluate(recipe.build_model(), recipe).show(console)
    text = console.export_text()
    for word in ("model", "nearest input", "mean colour", "PSNR", "SSIM", "dispersion"):
        assert word in text

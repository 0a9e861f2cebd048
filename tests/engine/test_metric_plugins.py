"""A metric that a plugin adds is shown wherever the built-in ones are."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, TypeAlias

import pytest
import torch
from rich.console import Console
from torch import Tensor
from training_runs import Tiny

from qgs.composer import Recipe, RecipeError, resolve
from qgs.contracts import (
    CONTRACT_VERSION,
    Column,
    ComponentConfig,
    Metric,
    MetricInput,
    Plugin,
    Scene,
)
from qgs.data.evaluation import evaluation_samples
from qgs.engine.distributed import make_accelerator
from qgs.engine.evaluation import Evaluation, evaluate
from qgs.engine.periodic import PeriodicEvaluation
from qgs.engine.protocol import protocol_of
from qgs.engine.tracking import Trackers


class MeanAbsoluteError(Metric):
    name: ClassVar[str] = "mae"
    definition: ClassVar[str] = "mean absolute error"
    column: ClassVar[Column] = Column("MAE", "lower", digits=5)
    not_in_protocol: ClassVar[frozenset[str]] = frozenset({"log"})

    class Config(ComponentConfig):
        power: float = 1.0
        log: str | None = None

    def forward(self, given: MetricInput) -> Tensor:
        error = (given.images - given.targets.images).abs() ** self.config.power
        return error.mean((-3, -2, -1))


class DepthError(Metric):
    name: ClassVar[str] = "depth"
    definition: ClassVar[str] = "rendered less true depth"
    needs = ("depth", "true_depth")
    column: ClassVar[Column] = Column("depth error", "lower")

    def forward(self, given: MetricInput) -> Tensor:
        return given.depth - given.true_depth


class Masked(Metric):
    name: ClassVar[str] = "masked"
    definition: ClassVar[str] = "mean of the mask"
    needs = ("masks",)

    def columns(self) -> Mapping[str, Column]:
        return {"mean": Column("masked", "higher")}

    def forward(self, given: MetricInput) -> Mapping[str, Tensor]:
        return {"mean": given.masks}


PLUGIN = Plugin("mine", CONTRACT_VERSION, (MeanAbsoluteError, DepthError, Masked))


Judged: TypeAlias = tuple[Recipe, Evaluation]


@pytest.fixture(scope="module")
def mine(tiny: Tiny) -> Tiny:
    """`mine("metrics.mae={type: mine/mae}")`: a small TokenGS with the plugin above."""
    tree, plugins = tiny("tokengs").tree, "plugins=[rooms, mine]"
    return lambda *more: resolve(tree, [plugins, *more], plugins=[PLUGIN])


@pytest.fixture
def judged(mine: Tiny) -> Judged:
    recipe = mine("metrics.error={type: mine/mae}")
    return recipe, evaluate(recipe.build_model(), recipe)


def shown(thing: object) -> str:
    console = Console(record=True, width=120, file=io.StringIO())
    thing.show(console) if hasattr(thing, "show") else console.print(thing)
    return console.export_text()


def test_evaluations_and_their_files(judged: Judged, tmp_path: Path) -> None:
    recipe, evaluation = judged
    sample = evaluation_samples(recipe.build_data(), recipe.views, recipe.evaluation)[0]
    grey = sample.inputs.images.mean((1, 3, 4))[0, :, None, None]
    expected = float((grey - sample.targets.images).abs().mean())
    assert evaluation.scores[0].values["mean_colour_error"] == pytest.approx(expected, rel=1e-5)
    text = shown(evaluation)
    assert "MAE ↓" in text
    assert f" {evaluation.mean('error'):.5f} " in text
    evaluation.write(tmp_path)
    rows = list(csv.DictReader((tmp_path / "scenes.csv").open()))
    summary = json.loads((tmp_path / "summary.json").read_text())
    mean = sum(float(row["model_error"]) for row in rows) / len(rows)
    assert summary["model"]["error"] == pytest.approx(mean)
    assert summary["nearest_input"]["error"] == evaluation.mean("error", "nearest_input")
    assert summary["columns"]["error"]["better"] == "lower"
    assert "   MAE ↓ |" in (tmp_path / "table.md").read_text()


def test_the_protocol_has_its_definition_and_options(mine: Tiny) -> None:
    def protocol(options: str) -> object:
        return protocol_of(mine(f"metrics.error={{type: mine/mae{options}}}"), None, ["x"])

    plain, same, other = protocol(""), protocol(", log: there"), protocol(", power: 2.0")
    told = {"type": "mine/mae", "definition": "mean absolute error", "power": 1.0}
    assert plain.content["metrics"]["error"] == told
    assert plain.sha256 == same.sha256 != other.sha256


def test_training_records_and_tracks_it(judged: Judged, tmp_path: Path) -> None:
    told: dict[str, float] = {}

    class Told(Trackers):
        def log(self, values: Mapping[str, float], step: int) -> None:
            told.update(values)

    recipe, evaluation = judged
    accelerator, model = make_accelerator("cpu"), recipe.build_model()
    PeriodicEvaluation(accelerator, recipe, model, None, tmp_path, Told(())).run(3)
    record = json.loads((tmp_path / "evaluations.jsonl").read_text())
    assert record["scores"]["error"] == evaluation.mean("error")
    assert told["evaluation/raw/error"] == record["scores"]["error"]


def test_what_a_metric_needs(mine: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = mine("metrics={depth: {type: mine/depth}, mask: {type: mine/masked}}")
    source = recipe.build_data()
    second = source.names("test")[1]

    def masks(scene: Scene, frames: Sequence[int]) -> Tensor | None:
        return None if scene.name == second else torch.ones(len(frames), 1, 16, 16)

    monkeypatch.setattr(type(source.scenes("test")[0]), "masks", masks)
    model = recipe.build_model().eval()
    evaluation = evaluate(model, recipe)
    sample = evaluation_samples(source, recipe.views, recipe.evaluation, depths=True)[0]
    with torch.no_grad():
        rendering = model.render(model(sample.inputs).gaussians, sample.targets.cameras)
    expected = float((rendering.depth - sample.targets.depths).mean())
    assert evaluation.scores[0].values["model_depth"] == pytest.approx(expected, rel=1e-5)
    assert evaluation.mean("depth", "nearest_input") is None
    assert evaluation.mean("mask_mean") == evaluation.mean("mask_mean", "mean_colour") == 1.0
    assert set(evaluation.incomplete) == {"mask_mean"}
    told = "masked is over 1 of 2 scenes: it needs masks, not known for 1 of 2 scenes"
    assert told in shown(evaluation)


def test_written_metrics_lie_over_the_default_ones(tiny: Tiny) -> None:
    recipe = tiny(
        "tokengs", "metrics={lpips: {type: lpips/vgg16}, psnr: null}", "plugins=[rooms, lpips]"
    )
    assert list(recipe.build_metrics()) == ["ssim", "dispersion", "lpips"]
    assert recipe.tree["metrics"]["psnr"] is None
    assert resolve(recipe.tree).tree == recipe.tree
    with pytest.raises(RecipeError, match=r"metrics\.psnr"):
        tiny("tokengs", "metrics.psnr.covariance=sample")

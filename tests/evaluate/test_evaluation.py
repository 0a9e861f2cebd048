"""Evaluation: the same twice, equal to the metrics it is made of, and nothing left out unsaid."""

import csv
import hashlib
import json
from collections import Counter
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from line_scenes import judged_samples
from tables import assert_equal, text_console
from training_runs import tiny

from qgs.contracts import CONTRACT_VERSION, Column, ComponentConfig, Metric, Plugin
from qgs.evaluate.evaluation import evaluate
from qgs.evaluate.protocol import protocol_of
from qgs.evaluate.results import METHODS
from qgs.metrics.baselines import mean_colour, nearest_input
from qgs.metrics.dispersion import token_dispersion
from qgs.metrics.images import psnr, ssim
from qgs.recipe import Recipe, resolve


class MeanAbsoluteError(Metric):
    name = "mae"
    definition = "mean absolute error"
    column = Column("MAE", "lower", digits=5)
    not_in_protocol = frozenset({"log"})

    class Config(ComponentConfig):
        power: float = 1.0
        log: str | None = None

    def forward(self, given):
        return ((given.images - given.targets.images).abs() ** self.config.power).mean((-3, -2, -1))


class DepthError(Metric):
    name = "depth"
    definition = "rendered less true depth"
    needs = ("depth", "true_depth")
    column = Column("depth error", "lower")

    def forward(self, given):
        return given.depth - given.true_depth


class Masked(Metric):
    name = "masked"
    definition = "mean of the mask"
    needs = ("masks",)

    def columns(self):
        return {"mean": Column("masked", "higher")}

    def forward(self, given):
        return {"mean": given.masks}


def mine(*options):
    """A small TokenGS with the plugin of the metrics above."""
    plugin = Plugin("mine", CONTRACT_VERSION, (MeanAbsoluteError, DepthError, Masked))
    options = "plugins=[rooms, mine]", *options
    return resolve(tiny("tokengs").tree, options, plugins=[plugin])


PARTLY = """{
"test/000000": {"context": [0, 3], "target": [1, 2]},
"test/000001": {"context": [0, 99], "target": [-1]},
"gone": {"context": [0, 3], "target": [1]},
"nil": null
}"""
"""Of the last three none can be judged."""


def shown(evaluation):
    console = text_console()
    evaluation.show(console)
    return console.file.getvalue()


@pytest.fixture(scope="module")
def judged():
    """A recipe with the metrics above, and two evaluations; only the first scene has masks."""
    metrics = (f"metrics.{name}={{type: mine/{name}}}" for name in ("mae", "depth", "masked"))
    recipe = mine(*metrics, "evaluation.protocol=rooms-2view")
    source = recipe.build_data()

    def masks(scene, frames):
        return torch.ones(len(frames), 1, 16, 16) if scene.name == "test/000000" else None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(source.scenes("test")[0]), "masks", masks)
        patch.setattr(Recipe, "build_data", opened := Mock(return_value=source))
        model = recipe.build_model().train()
        evaluations = evaluate(model, recipe), evaluate(model, recipe)
    assert opened.call_count == 2  # once each
    assert model.training
    return recipe, *evaluations


def test_scores_are_the_metrics_of_model_and_baselines(judged):
    recipe, evaluation, _ = judged
    model = recipe.build_model().eval()
    sample = judged_samples(recipe, depths=True)[0]
    inputs = sample.inputs
    targets = sample.targets
    with torch.no_grad():
        gaussians = model(inputs).gaussians
        rendering = model.render(gaussians, targets.cameras)
    images = {
        "model": rendering.rgb,
        "nearest_input": nearest_input(inputs, targets.cameras),
        "mean_colour": mean_colour(inputs, targets.cameras),
    }
    expected = {
        f"{method}_{metric.__name__}": metric(image, targets.images).mean()
        for method, image in images.items()
        for metric in (psnr, ssim)
    }
    expected["model_mae"] = (rendering.rgb - targets.images).abs().mean()
    expected["model_depth"] = (rendering.depth - targets.depths).mean()
    expected["model_dispersion_mean"] = token_dispersion(gaussians.means, 4).mean()
    expected["gaussians_used"] = (gaussians.opacities > 1 / 255).sum()
    score = evaluation.scores[0]
    for name, value in expected.items():
        assert score.values[name] == pytest.approx(value.item()), name
    assert score.views == [(sample.input_frames, sample.target_frames)]
    assert evaluation.gaussians == gaussians.count
    for name in ("depth", "dispersion_mean"):
        assert evaluation.mean(f"nearest_input_{name}") is None
    for method in METHODS:
        assert evaluation.mean(f"{method}_masked_mean") == 1.0
    assert set(evaluation.incomplete) == {"masked_mean"}


def test_evaluations_write_the_same_files(judged, tmp_path):
    for name, evaluation in zip("ab", judged[1:], strict=True):
        evaluation.write(tmp_path / name)
    files, again = ({p.name: p.read_bytes() for p in (tmp_path / n).iterdir()} for n in "ab")
    assert files == again
    assert files.keys() == {"protocol.json", "scenes.csv", "summary.json", "table.md"}
    summary = json.loads(files["summary.json"])
    rows = list(csv.DictReader(files["scenes.csv"].decode().splitlines()))
    assert [row["scene"] for row in rows] == ["test/000000", "test/000001"]
    assert summary["scenes"] == summary["samples"] == 2
    errors = np.array([float(row["model_mae"]) for row in rows])
    spread = {"mean": errors.mean(), "variance": errors.var(), "median": np.median(errors)}
    assert summary["over_scenes"]["mae"] == pytest.approx({**spread, "scenes": 2})
    for method in METHODS:
        mean = sum(float(row[f"{method}_mae"]) for row in rows) / 2
        assert summary[method]["mae"] == pytest.approx(mean)
    assert summary["columns"]["mae"]["better"] == "lower"
    protocol = summary["protocol"]
    assert protocol["name"] == "rooms-2view"
    assert hashlib.sha256(files["protocol.json"]).hexdigest() == protocol["sha256"]
    assert " MAE ↓ |" in files["table.md"].decode()
    told = "masked is not complete: it needs masks, which 1 of 2 scenes lack"
    for text in ("MAE ↓", f" {summary['model']['mae']:.5f} ", told):
        assert text in shown(evaluation)


def test_what_is_missing_is_told_in_the_same_line_as_the_score(tmp_path):
    index = tmp_path / "some_index.json"
    index.write_text(PARTLY)
    recipe = tiny("tokengs", f"evaluation.index={index}")
    evaluation = evaluate(recipe.build_model(), recipe)
    summary = evaluation.summary()
    assert summary["missing"] == {
        "test/000001": "the index names frames 99, -1, but the scene has only 0 to 7",
        "gone": "the test split has no such scene: correct its name in the index",
    }
    evaluation.write(tmp_path)
    table = (tmp_path / "table.md").read_text()
    for place in (shown(evaluation), table):
        assert "missing test/000001: the index names frames 99" in place
        assert "input views of 16 x 16 pixels, poses" in place
    assert all("1 of 3" in row for row in table.splitlines() if row.startswith("| model"))
    rows = csv.DictReader((tmp_path / "scenes.csv").open())
    told = {row["scene"]: row["problem"] for row in rows}
    assert told == {"test/000000": "", **summary["missing"]}


def test_a_failure_anywhere_ends_neither_evaluation_nor_in_silence(monkeypatch):
    """One failed sample fails its scene."""
    recipe = tiny("tokengs", "evaluation.scenes=4", "evaluation.samples=2")
    model = recipe.build_model()
    source = recipe.build_data()
    rooms = type(source.scenes("test")[0])
    images = rooms.images
    decoded = Counter()

    def images_of(scene, frames):
        decoded[scene.name] += 1
        place = source.names("test").index(scene.name)
        if place == 2 and decoded[scene.name] > 1:
            raise OSError("/data/set/truncated.png is cut off")
        return images(scene, frames) * [0, torch.nan, 1, 1][place]

    def refuse_black(encoder, given):
        if (given[0].images == 0).all((1, 2, 3, 4)).any():
            raise RuntimeError("out of memory")

    monkeypatch.setattr(rooms, "images", images_of)
    model.encoder.register_forward_pre_hook(refuse_black)
    evaluation = evaluate(model, recipe)
    assert [(score.scene, len(score.views)) for score in evaluation.scores] == [("test/000003", 2)]
    memory, finite, file = evaluation.missing.values()
    assert memory == "RuntimeError: out of memory"
    assert "is not finite" in finite
    assert file == "OSError: /data/set/truncated.png is cut off"


def test_tuned_evaluations_say_so_and_score_the_tuned_tokens():
    plain = tiny("locus")
    tuned = tiny("locus", "evaluation.tuning_steps=2")
    model = plain.build_model()
    first = evaluate(model, plain)
    second = evaluate(model, tuned)
    assert_equal(model.state_dict(), plain.build_model().state_dict())
    assert first.summary()["tuning"] is None
    told = second.summary()["tuning"]
    assert told["what"] == "queries"
    assert told["steps"] == 2
    assert first.scores[0].values["model_psnr"] != second.scores[0].values["model_psnr"]
    assert "queries tuned on the inputs: 2 Adam steps, learning rate 0.0001" in shown(second)


def test_a_protocol_has_a_metrics_definition_and_options():
    def protocol(options):
        return protocol_of(mine(f"metrics.error={{type: mine/mae{options}}}"), None, ["x"])

    plain = protocol("")
    same = protocol(", log: there")
    other = protocol(", power: 2.0")
    told = {"type": "mine/mae", "definition": "mean absolute error", "power": 1.0}
    assert plain.content["metrics"]["error"] == told
    assert plain.sha256 == same.sha256 != other.sha256

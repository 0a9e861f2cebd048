"""`qgs eval` as a user types it: indices, tuning, batches."""

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from commands import SMALL, run_qgs
from rich.console import Console

import qgs
from qgs.cli.evaluate import evaluation_folder
from qgs.cli.options import tuning_settings
from qgs.composer import resolve
from qgs.engine.training import train

RECIPES = Path(__file__).parents[2] / "recipes" / "tiny"
FEW = (*SMALL, "data.image_size=[32, 32]", "views.targets=2", "evaluation.scenes=3")


evaluated = partial(run_qgs, "eval")


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two untrained models, evaluated alike."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("locus", "tokengs"):
        model = qgs.compose(RECIPES / f"{name}.yaml", overrides=FEW)
        qgs.save(model, folder / name / "checkpoint.safetensors")
        result = evaluated(folder / name)
        assert result.exit_code == 0, result.output
    return folder


@pytest.fixture
def index(tmp_path: Path) -> Path:
    file = tmp_path / "two_rooms.json"
    entry = {"context": [0, 3], "target": [1, 2]}
    file.write_text(json.dumps({"test/000001": entry, "test/000002": entry, "absent": entry}))
    return file


def test_an_index_becomes_a_protocol_of_its_name(runs: Path, index: Path, tmp_path: Path) -> None:
    words = ("--index", index, "--out", tmp_path / "out", "--batch", 2)
    result = evaluated(runs / "locus", *words)
    assert result.exit_code == 0, result.output
    told = summary(tmp_path / "out")
    assert told["protocol"]["name"] == "two_rooms"
    assert told["protocol"]["settings"]["views"]["index"]["scenes"] == 3
    assert str(tmp_path) not in (tmp_path / "out" / "summary.json").read_text()


def test_tuning_goes_into_a_folder_of_its_own_and_is_told(runs: Path) -> None:
    run = runs / "locus"
    files = (run / "evaluation" / "summary.json", run / "checkpoint.safetensors")
    before = [file.read_bytes() for file in files]
    result = evaluated(run, "--tune", 2)
    assert result.exit_code == 0, result.output
    assert summary(run / "evaluation-2")["tuning"]["steps"] == 2
    assert [file.read_bytes() for file in files] == before


PLUGIN = """
from qgs.contracts import Column, Metric, Plugin
class Mean(Metric):
    name = "mean"
    definition, column = "mean colour", Column("level", "higher")
    def forward(self, given):
        return given.images.mean((-3, -2, -1))
plugin = Plugin("mine", 1, (Mean,))
"""


def test_a_metric_of_a_plugin_that_was_installed_later(
    runs: Path, tmp_path: Path, install: Callable[..., None]
) -> None:
    install("mine", "mine", PLUGIN)
    more = ("plugins=[mine]", "metrics.level.type=mine/mean")
    evaluated(runs / "tokengs", "--set", more[0], "--set", more[1], "--out", tmp_path / "out")
    assert "level" in summary(tmp_path / "out")["columns"]
    recipe = resolve(RECIPES / "tokengs.yaml", (*FEW, "training.steps=1"))
    for judged in (recipe, resolve(recipe.tree, ("training.steps=2", *more))):
        result = train(judged, tmp_path / "run", console=Console(quiet=True), resume=True)
    assert (result.resumed_at, (result.model.recipe or {})["plugins"]) == (1, ["rooms", "mine"])


def test_other_weights_of_a_run_keep_its_evaluation(tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert evaluation_folder(run / "checkpoint.safetensors", False) == run / "evaluation"
    assert evaluation_folder(run / "checkpoint_ema.safetensors", False) == run / "evaluation_ema"
    assert evaluation_folder(run / "published.safetensors", False) == run / "evaluation_published"
    (run / "evaluation_ema-2").mkdir(parents=True)
    ema = run / "checkpoint_ema.safetensors"
    assert evaluation_folder(ema, True) == run / "evaluation_ema-3"
    assert evaluation_folder(run / "checkpoint.safetensors", True) == run / "evaluation-2"


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["RUN", "--set", "training.steps=1"], "would change the trained model"),
        (["RUN", "--index", "it's not there.json"], "no evaluation index at it's not there.json"),
    ],
)
def test_what_cannot_be_done_is_refused(runs: Path, words: list[str], reason: str) -> None:
    result = evaluated(*(str(runs / "locus") if word == "RUN" else word for word in words))
    assert isinstance(result.exception, ValueError | FileNotFoundError)
    assert reason in str(result.exception)


def test_strict_evaluations_that_lack_a_scene_exit_with_1(
    runs: Path, index: Path, tmp_path: Path
) -> None:
    words = (runs / "locus", "--index", index, "--out", tmp_path / "out")
    assert evaluated(*words).exit_code == 0
    strict = evaluated(*words, "--strict")
    assert strict.exit_code == 1
    assert len(summary(tmp_path / "out")["missing"]) == 1
    index.write_text(json.dumps({"test/000001": {"context": [0, 3], "target": [1]}}))
    assert evaluated(*words, "--strict").exit_code == 0


def test_averaged_weights_of_a_run_are_named(runs: Path, tmp_path: Path) -> None:
    for name in ("checkpoint", "checkpoint_ema"):
        shutil.copy(runs / "locus" / "checkpoint.safetensors", tmp_path / f"{name}.safetensors")
    result = evaluated(tmp_path, "--set", "evaluation.scenes=1")
    assert f"qgs eval {tmp_path / 'checkpoint_ema.safetensors'}" in result.output


@pytest.mark.parametrize(
    ("tune", "steps", "what"),
    [
        ("7", 7, []),
        ("0", 0, []),
        ("latents", 50, ["evaluation.tuning=latents"]),
        ("queries:20", 20, ["evaluation.tuning=queries"]),
    ],
)
def test_tune_says_what_and_how_often(tune: str, steps: int, what: list[str]) -> None:
    assert tuning_settings(tune) == [f"evaluation.tuning_steps={steps}", *what]

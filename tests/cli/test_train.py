"""`qgs train` and `qgs eval` as a user types them."""

import json
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from commands import MODEL, run_qgs, sets
from typer.testing import Result

from qgs.cli.train import with_absolute_path
from qgs.composer import resolve
from qgs.engine import training

RECIPE = Path(__file__).parents[2] / "recipes" / "tiny" / "locus.yaml"
FINETUNE = RECIPE.parents[1] / "locus" / "dl3dv_4096_2views.yaml"
ROOMS = "data={type: rooms/procedural, image_size: [16, 16]}"
QUICK = (
    "data.image_size=[32, 32]",
    "views.targets=2",
    "evaluation.scenes=2",
    "training.seconds=null",
    "training.steps=2",
    "optimizer.warmup=1",
)


def train(out: Path, *words: str) -> Result:
    return run_qgs("train", RECIPE, "--out", out, *sets(*QUICK), *words)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("cli") / "run"
    result = train(out)
    assert result.exit_code == 0, result.output
    return out


def test_training_ends_with_an_evaluation(run: Path) -> None:
    files = {"checkpoint.safetensors", "history.jsonl", "recipe.yaml", "state.safetensors"}
    assert {path.name for path in run.iterdir()} == {"evaluation", *files}


def test_a_budget_of_time_is_named_beside_that_of_steps(tmp_path: Path) -> None:
    result = train(tmp_path / "run", *sets("training.seconds=77"))
    assert result.exit_code == 0, result.output
    assert re.search(r"77 s.* 2 steps", result.output)


def test_resume_leaves_a_finished_run_and_refuses_another_recipe(run: Path) -> None:
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    again = train(run, "--resume")
    assert again.exit_code == 0, again.output
    other = train(run, "--resume", "--set", "seed=3")
    assert "seed: 3" in str(other.exception)
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_eval_gives_the_same_numbers_and_shows_all_methods(run: Path) -> None:
    before = (run / "evaluation" / "summary.json").read_bytes()
    result = run_qgs("eval", run)
    assert result.exit_code == 0, result.output
    assert (run / "evaluation" / "summary.json").read_bytes() == before


def test_eval_of_other_settings_keeps_the_first_results(run: Path, tmp_path: Path) -> None:
    checkpoint = run / "checkpoint.safetensors"
    result = run_qgs("eval", checkpoint, "--set", "evaluation.scenes=1", "--out", tmp_path / "new")
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "new" / "summary.json").read_text())["scenes"] == 1
    before = (run / "evaluation" / "summary.json").read_bytes()
    for name in ("evaluation-2", "evaluation-3"):
        result = run_qgs("eval", run, "--set", "evaluation.scenes=1", "--device", "cpu")
        assert result.exit_code == 0, result.output
        summary = json.loads((run / name / "summary.json").read_text())
        settings = summary["protocol"]["settings"]
        assert settings["views"]["drawn"]["scenes"] == 1
        assert settings["image_size"] == [32, 32]
        assert summary["step"] == 2
        assert "held_out_frames" in summary
    assert (run / "evaluation" / "summary.json").read_bytes() == before


def test_a_signal_ends_with_its_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = training.train

    def stopped(*args: Any, **options: Any) -> training.TrainingResult:
        return replace(real(*args, **options), stopped_by="SIGTERM")

    monkeypatch.setattr(training, "train", stopped)
    result = train(tmp_path / "run")
    assert result.exit_code == 128 + 15
    assert not (tmp_path / "run" / "evaluation").exists()


def test_a_second_run_in_one_folder_is_refused(run: Path) -> None:
    before = (run / "checkpoint.safetensors").stat().st_mtime_ns
    result = train(run)
    assert isinstance(result.exception, FileExistsError)
    assert (run / "checkpoint.safetensors").stat().st_mtime_ns == before


def test_a_collapse_is_told_without_a_traceback(tmp_path: Path) -> None:
    result = train(tmp_path / "run", "--set", "model.head.opacity_bias=-20.0")
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert "training collapsed" in result.output
    assert (tmp_path / "run" / "checkpoint.safetensors").is_file()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ((), "no evaluation index at .*datasets/dl3dv/evaluation_2views.json"),
        (("evaluation.index=null", "init_from=null"), "datasets/dl3dv"),
        (("evaluation.index=null", "plugins=[rooms]", ROOMS), "runs/locus/dl3dv"),
    ],
)
def test_what_is_missing_is_told_before_training(
    overrides: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run_qgs("train", FINETUNE, "--out", "run", "--device", "cpu", *sets(*overrides))
    assert isinstance(result.exception, FileNotFoundError)
    with pytest.raises(FileNotFoundError, match=message):
        raise result.exception
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("photos", "{here}/photos"),
        ("../photos", "{above}/photos"),
        ("~/photos", "{home}/photos"),
        ("/data/photos", "/data/photos"),
        ("memory://bucket/photos", "memory://bucket/photos"),
        ("zip://a::file://{here}/photos.zip", "zip://a::file://{here}/photos.zip"),
    ],
)
def test_paths_become_absolute_and_urls_stay(given, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"here": tmp_path, "above": tmp_path.parent, "home": Path.home()}
    zipfile.ZipFile(tmp_path / "photos.zip", "w").close()
    data = {"type": "qgs/photos", "path": given.format(**names), "image_size": [16, 16]}
    recipe = with_absolute_path(resolve({"recipe": 1, "model": MODEL, "data": data}))
    assert recipe.tree["data"]["path"] == expected.format(**names)


def test_data_without_a_path_stays():
    data = {"type": "rooms/procedural", "image_size": [16, 16]}
    recipe = resolve({"recipe": 1, "model": MODEL, "plugins": ["rooms"], "data": data})
    assert with_absolute_path(recipe).tree == recipe.tree

"""`qgs train` as a user types it, and what `qgs eval` of its run leaves as it was."""

import re
import signal
import zipfile
from pathlib import Path

from commands import ONE_LAYER, done, sets
from tables import contents, must_not_find, names_in

from qgs.cli.train import with_absolute_path
from qgs.recipe import resolve
from qgs.train.tracking import TrainingProgress

FINETUNE = "locus/dl3dv_4096_2views.yaml"
ROOMS = "data={type: rooms/procedural, image_size: [16, 16]}"


def test_training_names_its_budgets_and_ends_with_an_evaluation(trained):
    output, run = trained
    assert re.search(r"77 s.* 2 steps", output)
    files = {"checkpoint.safetensors", "history.jsonl", "recipe.yaml", "state.safetensors"}
    assert names_in(run) == {"evaluation", *files}


def test_a_finished_run_is_left_as_it_is(training, trained):
    """By the same command, a new run in its folder and `qgs eval`."""
    _, run = trained
    before = contents(run)
    assert training(f"{run} --resume").exit_code == 0
    assert isinstance(training(run).exception, FileExistsError)
    assert contents(run) == before
    done(f"eval {run}")
    assert all(path.read_bytes() == text for path, (text, _) in before.items())


def test_a_signal_ends_with_its_number(training, tmp_path, monkeypatch):
    monkeypatch.setattr(TrainingProgress, "show", lambda *_: signal.raise_signal(signal.SIGTERM))
    assert training(f"{tmp_path}/run").exit_code == 128 + 15
    assert not (tmp_path / "run/evaluation").exists()


def test_a_collapse_is_told_without_a_traceback(training, tmp_path):
    result = training(f"{tmp_path}/run --set model.head.opacity_bias=-20.0")
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert "training collapsed" in result.output


def test_what_is_missing_is_told_before_training(here):
    cases = (
        ((), "no evaluation index at .*datasets/dl3dv/evaluation_2views.json"),
        (("evaluation.index=null", "init_from=null"), "datasets/dl3dv"),
        (("evaluation.index=null", "plugins=[rooms]", ROOMS), "runs/locus/dl3dv"),
    )
    for overrides, message in cases:
        must_not_find(message, done, f"train {FINETUNE} --out run --device cpu", *sets(*overrides))
        assert not names_in(here)


def test_paths_become_absolute_and_urls_stay(here):
    zipfile.ZipFile("photos.zip", "w").close()
    recipe = ONE_LAYER | {"plugins": ["rooms"]}
    for path, absolute in (
        ("../photos", f"{here.parent}/photos"),
        ("~/photos", f"{Path.home()}/photos"),
        ("memory://bucket/photos", "memory://bucket/photos"),
        (archive := f"zip://a::file://{here}/photos.zip", archive),
    ):
        photos = resolve(recipe, [f"data={{type: qgs/photos, path: '{path}', image_size: [8, 8]}}"])
        assert with_absolute_path(photos).tree["data"]["path"] == absolute
    without = resolve(recipe, [ROOMS])
    assert with_absolute_path(without).tree == without.tree

"""Whole runs of tiny models on procedural rooms."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest
import torch
from training_runs import Tiny, run_anywhere

import qgs
from qgs.composer import resolve
from qgs.contracts import TrainingConfig
from qgs.data.stream import training_batches
from qgs.engine.folder import RunFolder
from qgs.io.checkpoint import CheckpointFile


@pytest.mark.parametrize("name", [pytest.param("tokengs", marks=pytest.mark.slow), "locus"])
def test_training_lowers_the_loss(tiny: Tiny, tmp_path: Path, name: str) -> None:
    options = ("training.steps=40", "optimizer.warmup=4", "data.scenes=1", "views.mirror=0.0")
    result = run_anywhere(tiny(name, *options), tmp_path / "run")
    losses = [record["loss"] for record in result.folder.history()]
    assert result.steps == len(losses) == 40
    assert sum(losses[-10:]) < 0.95 * sum(losses[:10])


def test_a_run_leaves_recipe_history_and_checkpoint(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny("locus")
    result = run_anywhere(recipe, tmp_path / "run")
    assert resolve(tmp_path / "run" / "recipe.yaml").tree == recipe.tree
    history = result.folder.history()
    assert [record["step"] for record in history] == [1, 2, 3, 4]
    terms = {"mse", "ssim", "visibility", "anchor_visibility"}
    assert terms | {"loss", "psnr", "lr", "seconds", "gradient"} <= history[0].keys()
    for record in history:
        assert record["loss"] == pytest.approx(sum(record[term] for term in terms))
    assert CheckpointFile(result.folder.checkpoint).step == 4
    loaded = qgs.load(result.folder.checkpoint)
    batch = next(training_batches(recipe.build_data(), recipe.views, 1, seed=1))
    with torch.no_grad():
        torch.testing.assert_close(
            loaded(batch.inputs).gaussians.means, result.model(batch.inputs).gaussians.means
        )


def test_accumulated_batches_are_one_larger_batch(tiny: Tiny, tmp_path: Path) -> None:
    first = []
    for count in (1, 2):
        options = ("batch_size=2", f"accumulate={count}", "steps=1")
        recipe = tiny("tokengs", "optimizer.warmup=0", *(f"training.{o}" for o in options))
        result = run_anywhere(recipe, tmp_path / str(count))
        first.append(result.folder.history()[0])
    for key in ("loss", "mse", "visibility", "gradient"):
        assert first[0][key] == pytest.approx(first[1][key], rel=1e-4)


@pytest.mark.parametrize(("processes", "accumulate"), [(3, 1), (1, 5), (8, 4)])
def test_scenes_that_do_not_split_evenly_are_refused(processes: int, accumulate: int) -> None:
    config = TrainingConfig(batch_size=16, accumulate=accumulate)
    with pytest.raises(ValueError, match=rf"training\.batch_size: 16 .* {processes * accumulate}"):
        config.scenes_per_batch(processes)


def test_bf16_trains_with_finite_numbers(tiny: Tiny, tmp_path: Path) -> None:
    result = run_anywhere(tiny("locus", "training.precision=bf16"), tmp_path / "run")
    assert all(p.dtype == torch.float32 for p in result.model.parameters())
    assert all(p.isfinite().all() for p in result.model.parameters())


def test_a_time_budget_ends_the_run(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny("tokengs", "training.steps=100000", "training.seconds=1.0")
    result = run_anywhere(recipe, tmp_path / "run")
    assert 1.0 <= result.seconds < 10.0
    assert 1 < result.steps < 100_000
    history = result.folder.history()
    assert history[0]["seconds"] == 0
    schedule = recipe.build_optimizer()
    clock = [0.0, *(record["seconds"] for record in history)]
    expected = [schedule.learning_rate(step, clock[step]) for step in range(len(history))]
    assert [record["lr"] for record in history] == pytest.approx(expected)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_ends(tiny: Tiny, tmp_path: Path, number: signal.Signals) -> None:
    before = signal.getsignal(number)
    history = tmp_path / "run" / "history.jsonl"

    def interrupt_once_training() -> None:
        ends = time.monotonic() + 60
        while not history.exists() and time.monotonic() < ends:
            threading.Event().wait(0.05)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=interrupt_once_training, daemon=True)
    thread.start()
    result = run_anywhere(tiny("tokengs", "training.steps=100000"), history.parent)
    thread.join(timeout=60)
    assert result.stopped_by == number.name
    assert result.steps == len(result.folder.history())
    assert CheckpointFile(result.folder.checkpoint).step == result.steps
    assert signal.getsignal(number) is before


def test_a_folder_in_use_is_refused_untouched(tiny: Tiny, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="never overwrites"):
        run_anywhere(tiny("tokengs"), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(FileExistsError, match="is a file"):
        RunFolder(tmp_path / "notes.txt").refuse_other(resume=False)


def test_a_start_that_fails_leaves_no_folder(tiny: Tiny, tmp_path: Path) -> None:
    out = tmp_path / "run"
    photos = {"type": "qgs/photos", "path": str(tmp_path / "nowhere"), "image_size": [32, 32]}
    with pytest.raises(FileNotFoundError, match="nowhere"):
        run_anywhere(resolve({**tiny("tokengs").tree, "data": photos}), out)
    with pytest.raises(ValueError, match=r"optimizer\.warmup"):
        run_anywhere(tiny("tokengs", "optimizer.warmup=4"), out)
    with pytest.raises(ValueError, match=r"views\.gap"):
        run_anywhere(tiny("tokengs", "views.inputs=9", "views.gap=[2, 3]"), out)
    assert not out.exists()

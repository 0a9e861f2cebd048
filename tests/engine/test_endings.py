"""Errors between two steps lose nothing: the run is saved, and says how to go on."""

import json
import multiprocessing
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from safetensors import SafetensorError
from training_runs import QUIET, Tiny, change_batches, losses, run, run_calling, same, weights

from qgs.data.samples import Batch
from qgs.data.stream import WorkerError
from qgs.engine import periodic
from qgs.engine.distributed import StopRequest, signal
from qgs.engine.folder import RunFolder as Folder
from qgs.engine.folder import read_state
from qgs.engine.tracking import TrainingProgress
from qgs.engine.training import Trainer


def saved_step(folder: Path) -> int:
    return read_state(Folder(folder).state).parts["counters"]["step"]


def spoil(monkeypatch: pytest.MonkeyPatch, from_sample: int) -> None:
    """From this sample on, the data cannot be read."""

    def broken(batch: Batch, numbers: Sequence[int]) -> None:
        if max(numbers) >= from_sample:
            raise OSError("the disk is gone")

    change_batches(monkeypatch, broken)


def test_data_that_fails_leaves_a_run_that_goes_on(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = tiny("tokengs", "training.save_every=0", "training.batch_size=2", "training.ema=0.9")
    through = run(recipe, tmp_path / "through")
    with monkeypatch.context() as patch:
        spoil(patch, from_sample=6)
        with pytest.raises(OSError, match="the disk is gone") as caught:
            run(recipe, tmp_path / "broken")
    assert caught.value.__notes__ == ["The run is saved at step 3; continue with --resume"]
    assert saved_step(tmp_path / "broken") == 3
    again = run(recipe, tmp_path / "broken", resume=True)
    assert (again.resumed_at, again.steps) == (3, 4)
    assert losses(tmp_path / "broken") == losses(tmp_path / "through")
    assert same(weights(again), weights(through))


@pytest.mark.slow
def test_a_killed_worker_leaves_a_run_that_goes_on(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny("tokengs", "training.steps=100", "training.workers=1", "training.save_every=0")

    def kill(trainer: Trainer, stop: StopRequest) -> None:
        for child in multiprocessing.active_children():
            child.kill()

    with pytest.raises(WorkerError, match=r"lower training\.workers"):
        run_calling(kill, recipe, tmp_path / "run")
    assert saved_step(tmp_path / "run") == len(losses(tmp_path / "run")) >= 1


def test_an_evaluation_that_fails_is_told_and_ends_nothing(
    tiny: Tiny,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    steps: list[int] = []

    def failing(model: Any, recipe: Any, step: int, **_: Any) -> None:
        steps.append(saved_step(tmp_path / "run"))
        raise ValueError("no scene could be judged")

    monkeypatch.setattr(periodic, "evaluate", failing)
    recipe = tiny("tokengs", "training.evaluate_every=2", "training.save_every=0")
    result = run(recipe, tmp_path / "run")
    assert result.steps == 4
    assert steps == [2, 4], "saved before it is judged"
    assert "the evaluation at step 2 failed: ValueError: no scene could be judged" in caplog.text


def test_a_stop_is_heard_between_two_scenes(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny("tokengs", "training.evaluate_every=2", "evaluation.scenes=3")
    trainer, stop = Trainer(recipe, tmp_path / "run"), StopRequest()
    scenes: list[int] = []
    between = trainer.evaluations._between_scenes

    def asked(done: int, wanted: int) -> None:
        scenes.append(done)
        stop.signal = signal.SIGTERM
        between(done, wanted)

    trainer.evaluations._between_scenes = asked
    with closing(trainer):
        result = trainer.run(TrainingProgress(QUIET), stop)
    assert scenes == [1]
    assert (result.steps, result.stopped_by) == (2, "SIGTERM")
    assert not (tmp_path / "run" / "evaluations.jsonl").exists()


def test_a_full_disk_is_told_with_what_to_do(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(tensors: Any, path: Path, metadata: Any) -> None:
        path.write_bytes(bytes(40_000))
        raise SafetensorError("I/O error: No space left on device (os error 28)")

    recipe, folder = tiny("tokengs", "training.save_every=1"), tmp_path / "run"
    run(tiny("tokengs", "training.steps=3"), folder)
    whole = Folder(folder).state.read_bytes()
    with monkeypatch.context() as patched:
        patched.setattr("qgs.io.tensors.save_file", full)
        with pytest.raises(OSError, match="--resume"):
            run(recipe, folder, resume=True)
    assert Folder(folder).state.read_bytes() == whole
    assert run(recipe, folder, resume=True).steps == 4


@pytest.mark.parametrize("damage", ['{"step": 2, "lo', "[1]"])
def test_a_damaged_line_stops_no_run(
    tiny: Tiny, tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    folder = tmp_path / "run"
    run(tiny("tokengs", "training.steps=3", "training.evaluate_every=3"), folder)
    for name in ("history.jsonl", "evaluations.jsonl"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join([damage, *lines]) + "\n")
    run(tiny("tokengs", "training.evaluate_every=4"), folder, resume=True)
    for name, steps in (("history.jsonl", [1, 2, 3, 4]), ("evaluations.jsonl", [3, 4])):
        assert f"{folder / name}, line 1 is damaged" in caplog.text
        lines = (folder / name).read_text().splitlines()
        assert [json.loads(line)["step"] for line in lines] == steps

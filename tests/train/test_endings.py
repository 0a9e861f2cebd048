"""Whatever ends a run early loses nothing: the run is saved, and says how to go on."""

import multiprocessing
import signal
from pathlib import Path
from unittest.mock import DEFAULT, Mock

import pytest
import torch
from safetensors import SafetensorError
from tables import contents, must_not_find, must_refuse, names_in
from training_runs import (
    TRAINED,
    assert_equal_runs,
    change_samples,
    losses,
    read_jsonl,
    resume,
    run,
    run_calling,
    saved_step,
    spoil,
    tiny,
)

from qgs.checkpoint.model_file import CheckpointFile
from qgs.checkpoint.tensors import CheckpointError, TensorFile, write_tensors
from qgs.data.stream import MAX_REPLACED, SampleError, WorkerError
from qgs.train import periodic, training
from qgs.train.folder import RunFolder
from qgs.train.guard import OutOfMemoryError
from qgs.train.tracking import TrainingProgress

LONGER = tiny("locus", TRAINED, "training.steps=4")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_ends(monkeypatch, number):
    before = signal.getsignal(number)

    def ask_twice(*_):
        signal.raise_signal(number)
        signal.raise_signal(number)  # the second one changes nothing

    monkeypatch.setattr(TrainingProgress, "show", ask_twice)
    result = run(tiny("tokengs", "training.steps=200"))
    assert result.stopped_by == number.name
    assert result.steps == len(result.folder.history()) == 1
    assert CheckpointFile(result.folder.checkpoint).step == 1
    assert signal.getsignal(number) is before


def test_data_that_fails_leaves_a_run_that_goes_on(trained_run, monkeypatch):
    def broken(sample, number, attempt):
        if number == 4:
            raise OSError("the disk is gone")

    with monkeypatch.context() as patch:
        change_samples(patch, broken)
        recipe = tiny("locus", TRAINED, "training.evaluate_every=0")
        error = must_refuse("the disk is gone", run, recipe, kind=OSError)
    assert error.__notes__ == ["The run is saved at step 2; continue with --resume"]
    assert resume(tiny("locus", TRAINED)).resumed_at == 2
    whole = trained_run.folder.path
    assert_equal_runs("run", whole)
    first, second = (read_jsonl(folder / "evaluations.jsonl") for folder in (Path("run"), whole))
    assert first == second[2:]  # of step 3


@pytest.mark.slow
def test_a_killed_worker_leaves_a_run_that_goes_on():
    recipe = tiny("tokengs", "training={steps: 100, workers: 1, save_every: 0}")

    def kill(trainer, stop):
        for child in multiprocessing.active_children():
            child.kill()

    must_refuse(r"lower training\.workers", run_calling, kill, recipe, kind=WorkerError)
    assert saved_step() == len(losses()) >= 1


def test_a_step_without_memory_says_what_takes_less_and_the_run_is_saved(monkeypatch):
    error = RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried")
    second_fails = Mock(wraps=training.compute_gradients, side_effect=[DEFAULT, error])
    monkeypatch.setattr(training, "compute_gradients", second_fails)
    must_refuse(r"step 2.*batch_size", run, tiny("tokengs"), kind=OutOfMemoryError)
    assert saved_step() == 1


def test_bad_samples_are_skipped_and_named_if_asked_for(monkeypatch, caplog):
    bad = {1, 3}
    spoil(monkeypatch, bad)
    must_refuse("frame 1", run, tiny("tokengs"), "stops", kind=SampleError)
    skipping = tiny("tokengs", "training.on_bad_sample=skip")
    assert run(skipping, "skips").steps == 3
    assert caplog.text.count("a training sample is left out: scene 'x', frame ") == 2
    bad.update(range(100))
    must_refuse(str(MAX_REPLACED + 1), run, skipping, "ends", kind=SampleError)


def test_an_evaluation_that_fails_is_told_and_ends_nothing(monkeypatch, caplog):
    saved = []

    def failing(*_, **options):
        saved.append(saved_step())
        raise ValueError("no scene could be judged")

    monkeypatch.setattr(periodic, "evaluate", failing)
    run(tiny("tokengs", "training.evaluate_every=1"))
    assert saved == [1, 2, 3]  # saved before it is judged
    assert "the evaluation at step 2 failed: no scene could be judged" in caplog.text


def test_a_stop_is_heard_between_two_scenes(monkeypatch):
    judge = periodic.evaluate

    def asked(*given, observe, **options):
        def seen(done, wanted):
            assert done == 1
            signal.raise_signal(signal.SIGTERM)
            observe(done, wanted)

        return judge(*given, observe=seen, **options)

    monkeypatch.setattr(periodic, "evaluate", asked)
    result = run(tiny("tokengs", "training.evaluate_every=1"))
    assert result.steps == 1
    assert result.stopped_by == "SIGTERM"
    assert not Path("run/evaluations.jsonl").exists()


def test_a_full_disk_is_told_with_what_to_do(copied, monkeypatch):
    def full(tensors, path, metadata):
        path.write_bytes(bytes(40_000))
        raise SafetensorError("I/O error: No space left on device (os error 28)")

    state = RunFolder(copied).state
    whole = state.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr("qgs.checkpoint.tensors.save_file", full)
        must_refuse("--resume", resume, LONGER, copied, kind=OSError)
    assert state.read_bytes() == whole
    assert resume(LONGER, copied).steps == 4


def test_a_damaged_state_is_refused_and_nothing_is_replaced(copied):
    state = RunFolder(copied).state
    file = TensorFile(state)
    tensors = file.read()
    metadata = file.metadata
    damaged = [state.read_bytes()[:-100], RunFolder(copied).checkpoint.read_bytes()]
    for name, changed in (
        ("weights.queries.features", torch.ones(1)),
        ("ema.queries.features", None),
        ("moments.model.queries.features.exp_avg", None),
        ("random.", None),
    ):
        kept = {n: tensor for n, tensor in tensors.items() if not n.startswith(name)}
        write_tensors(state, kept if changed is None else kept | {name: changed}, metadata)
        damaged.append(state.read_bytes())
    for text in ("null", '{"counters": ', '{"a":' * 5000, '{"weights": {}}'):
        write_tensors(state, tensors, metadata | {"qgs.state": text})
        damaged.append(state.read_bytes())
    for content in damaged:
        state.write_bytes(content)
        before = contents(copied)
        must_refuse(str(state), resume, LONGER, copied, kind=CheckpointError)
        assert before == contents(copied)


def test_a_folder_in_use_is_refused_untouched(here):
    (here / "notes.txt").write_text("mine")
    must_refuse("never overwrites", run, tiny("tokengs"), here, kind=FileExistsError)
    must_refuse("is a file", run, tiny("tokengs"), "notes.txt", kind=FileExistsError)
    assert names_in(here) == {"notes.txt"}


def test_a_start_that_fails_leaves_no_folder(here):
    nowhere = "data={type: qgs/photos, path: nowhere, image_size: [32, 32]}"
    must_not_find("nowhere", run, tiny("tokengs", nowhere))
    must_refuse(r"optimizer\.warmup", run, tiny("tokengs", "optimizer.warmup=3"))
    must_refuse(r"views\.gap", run, tiny("tokengs", "views={inputs: 9, gap: [2, 3]}"))
    assert not names_in(here)

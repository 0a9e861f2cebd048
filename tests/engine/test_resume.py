"""A run that was interrupted or killed, and continued, is the run that was not."""

import json
import os
import random
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from accelerate import Accelerator
from training_runs import Tiny, run, run_calling, same, weights

from qgs.composer import Recipe
from qgs.engine.distributed import RandomStates, StopRequest
from qgs.engine.folder import OtherRunError, RunFolder, read_state, write_state
from qgs.engine.training import Trainer
from qgs.io.checkpoint import CheckpointFile
from qgs.io.tensors import CheckpointError


class Killed(BaseException):
    """Ends a run as a kill does, from the loop's point of view: nothing is saved any more."""


def kill_after(steps: int, recipe: Recipe, folder: Path, resume: bool = False) -> None:
    def kill(trainer: Trainer, stop: StopRequest) -> None:
        if trainer.step == steps:
            raise Killed

    with pytest.raises(Killed):
        run_calling(kill, recipe, folder, resume)


resumed = partial(run, resume=True)


def assert_equal_runs(first: Path, second: Path) -> None:
    """Same weights, optimiser state and random states to the bit, same history but for time."""
    ours, theirs = (read_state(RunFolder(folder).state).parts for folder in (first, second))
    assert ours.keys() == theirs.keys()
    for name in ours:
        assert ours[name].keys() == theirs[name].keys(), name
        for key, value in ours[name].items():
            if key == "seconds":
                continue
            other = theirs[name][key]
            same = torch.equal(value, other) if torch.is_tensor(value) else value == other
            assert same, f"{name}/{key}"
    assert losses(first) == losses(second)


def losses(folder: Path) -> list[tuple[float, float, float]]:
    history = RunFolder(folder).history()
    return [(record["step"], record["loss"], record["lr"]) for record in history]


def change_counters(folder: Path, **values: Any) -> None:
    state = read_state(folder / "state.safetensors")
    parts = {**state.parts, "counters": {**state.parts["counters"], **values}}
    write_state(folder / "state.safetensors", state.recipe.tree, parts)


CASES = [
    ("locus", ("training.ema=0.9", "training.render_views=1")),
    ("tokengs", ("training.accumulate=2", "views.mirror=0.5")),
    ("locus", ("training.precision=bf16",)),
]


@pytest.mark.slow  # test_scheduled_options.py and test_objectives.py resume in the fast tests
@pytest.mark.parametrize(("name", "overrides"), CASES)
def test_13_and_7_steps_are_20(
    tiny: Tiny, tmp_path: Path, name: str, overrides: Sequence[str]
) -> None:
    options = ("steps=20", "save_every=5", "collapse_window=10")
    recipe = tiny(name, *(f"training.{option}" for option in options), *overrides)
    run(recipe, tmp_path / "through")
    kill_after(13, recipe, tmp_path / "killed")
    assert len(RunFolder(tmp_path / "killed").history()) == 13
    result = resumed(recipe, tmp_path / "killed")
    assert (result.resumed_at, result.steps) == (10, 20)
    assert_equal_runs(tmp_path / "through", tmp_path / "killed")


@pytest.mark.slow
def test_workers_and_several_kills_change_nothing(tiny: Tiny, tmp_path: Path) -> None:
    options = ("training.steps=40", "training.save_every=1")
    recipe, with_workers = (tiny("locus", *options, f"training.workers={n}") for n in (0, 2))
    run(recipe, tmp_path / "through")
    kill_after(9, with_workers, tmp_path / "killed")
    kill_after(17, with_workers, tmp_path / "killed", resume=True)
    kill_after(18, recipe, tmp_path / "killed", resume=True)
    resumed(with_workers, tmp_path / "killed")
    assert_equal_runs(tmp_path / "through", tmp_path / "killed")


def test_a_stopped_run_goes_on_where_it_stopped(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny("locus", "training.save_every=0")
    run(recipe, tmp_path / "through")

    def ask(trainer: Trainer, stop: StopRequest) -> None:
        stop.signal = None if trainer.step < 2 else signal.SIGTERM

    stopped = run_calling(ask, recipe, tmp_path / "stopped")
    assert stopped.steps == 3, "a request is seen at the end of the step in which it comes"
    assert resumed(recipe, tmp_path / "stopped").resumed_at == 3
    assert_equal_runs(tmp_path / "through", tmp_path / "stopped")


def test_resume_starts_a_run_that_is_new_and_leaves_a_finished_one(
    tiny: Tiny, tmp_path: Path
) -> None:
    recipe, folder = tiny("tokengs"), tmp_path / "run"
    first = resumed(recipe, folder)
    assert (first.resumed_at, first.steps) == (None, 4)
    files = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    again = resumed(recipe, folder)
    assert (again.resumed_at, again.steps, again.stopped_by) == (4, 4, None)
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == files
    assert same(weights(first), weights(again))


def test_a_kill_between_the_first_two_files_loses_nothing(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, folder = tiny("tokengs", "training.save_every=0"), tmp_path / "run"

    with monkeypatch.context() as patch:
        patch.setattr("qgs.engine.folder.save", Mock(side_effect=Killed))
        with pytest.raises(Killed):
            run(recipe, folder)
    assert not (folder / "checkpoint.safetensors").exists()
    assert resumed(recipe, folder).resumed_at == 4
    assert CheckpointFile(folder / "checkpoint.safetensors").step == 4


def test_a_longer_budget_continues_a_finished_run(tiny: Tiny, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    resumed(tiny("tokengs"), folder)
    longer = tiny("tokengs", "training.steps=6", "evaluation.scenes=1", "training.save_every=7")
    assert resumed(longer, folder).steps == 6
    assert [step for step, *_ in losses(folder)] == [1, 2, 3, 4, 5, 6]
    assert "steps: 6" in (folder / "recipe.yaml").read_text()
    assert CheckpointFile(folder / "checkpoint.safetensors").step == 6


def test_the_clock_goes_on(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny("tokengs", "training.steps=100000", "training.seconds=1.5")
    kill_after(5, tiny("tokengs", "training.steps=5", "training.save_every=4"), tmp_path / "run")
    change_counters(tmp_path / "run", seconds=1.0)
    result = resumed(recipe, tmp_path / "run")
    history = result.folder.history()
    assert [record["seconds"] for record in history[4:6]] == [1.0, history[5]["seconds"]]
    assert 1.5 <= result.seconds < 10


def test_a_run_killed_before_its_first_save_starts_again(tiny: Tiny, tmp_path: Path) -> None:
    recipe, folder = tiny("locus"), tmp_path / "run"
    kill_after(2, recipe, folder)
    for name in (".state.safetensors.4711.tmp", ".tmpA9b0zZ"):
        (folder / name).write_text("half a state")
    with (folder / "history.jsonl").open("a") as file:
        file.write('{"step": 3, "lo')
    with pytest.raises(OtherRunError, match=r"seed: 1 here, 0 in the run"):
        resumed(tiny("locus", "seed=1"), folder)
    assert resumed(recipe, folder).resumed_at is None
    assert [step for step, *_ in losses(folder)] == [1, 2, 3, 4]
    assert not list(folder.glob(".*"))


def test_another_recipe_is_refused_by_its_keys(tiny: Tiny, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    kill_after(2, tiny("tokengs", "training.save_every=1"), folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    other = ("optimizer.learning_rate=1e-3", "seed=4", "training.save_every=3")
    with pytest.raises(OtherRunError) as caught:
        resumed(tiny("tokengs", *other), folder)
    message = str(caught.value)
    assert "optimizer.learning_rate: 0.001 here, 0.0015 in the run" in message
    assert "seed: 4 here, 0 in the run" in message
    assert "training.save_every:" not in message
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_step_must_see_as_many_samples(tiny: Tiny, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    recipe = tiny("tokengs", "training.batch_size=2", "training.save_every=1")
    run(recipe, tmp_path / "through")
    kill_after(2, recipe, folder)
    with pytest.raises(OtherRunError, match=r"see 2 samples.*see 3.*batch_size=2"):
        resumed(tiny("tokengs", "training.batch_size=3"), folder)
    halves = tiny("tokengs", "training.batch_size=2", "training.accumulate=2")
    assert resumed(halves, folder).steps == 4
    for ours, theirs in zip(losses(folder), losses(tmp_path / "through"), strict=True):
        assert ours == pytest.approx(theirs, rel=1e-4)


def test_other_scenes_are_refused(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny("tokengs", "training.save_every=1")
    kill_after(2, recipe, tmp_path / "run")
    change_counters(tmp_path / "run", scenes="others")
    with pytest.raises(OtherRunError, match="other training scenes"):
        resumed(recipe, tmp_path / "run")


def test_one_process_at_a_time_trains_in_a_folder(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny("tokengs")
    kill_after(2, recipe, tmp_path / "run")
    folder = RunFolder(tmp_path / "run")
    folder.take()
    with pytest.raises(FileExistsError, match="another process is training"):
        resumed(recipe, tmp_path / "run")
    folder.close()
    assert resumed(recipe, tmp_path / "run").steps == 4


def test_a_state_that_is_cut_off_or_something_else_is_refused(tiny: Tiny, tmp_path: Path) -> None:
    recipe, folder = tiny("tokengs", "training.save_every=1"), tmp_path / "run"
    kill_after(2, recipe, folder)
    file = folder / "state.safetensors"
    for content in (file.read_bytes()[:-100], (folder / "checkpoint.safetensors").read_bytes()):
        file.write_bytes(content)
        with pytest.raises(CheckpointError, match=str(file)):
            resumed(recipe, folder)


def test_random_states_come_back() -> None:
    states = RandomStates(Accelerator(cpu=True))

    def draw() -> tuple[float, float, float]:
        return random.random(), float(np.random.normal()), float(torch.rand(()))

    np.random.normal()
    saved = states.state()
    as_json = {k: v for k, v in saved.items() if not torch.is_tensor(v)}
    first = draw()
    draw()
    states.load_state({**saved, **json.loads(json.dumps(as_json))})
    assert draw() == first


@pytest.mark.slow
def test_killed_runs_go_on_from_whole_files() -> None:
    """Some kills must come inside a save, for this to prove anything."""
    tool = Path(__file__).parents[2] / "tools" / "kill.py"
    done = subprocess.run(
        [sys.executable, str(tool), "training", "--kills=12", "--width=192", "--steps=150"],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=1200,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.match(r"12 kills, [1-9]\d* inside a save", done.stdout), done.stdout

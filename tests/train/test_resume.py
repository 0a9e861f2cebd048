"""A run that was interrupted or killed, and continued, is the run that was not."""

import math
import re
import shutil
import signal
import subprocess
import sys
from unittest.mock import Mock

import pytest
from size import ROOT
from tables import assert_equal, assert_near, contents, must_refuse
from training_runs import (
    TRAINED,
    TWO,
    assert_equal_runs,
    column,
    read_jsonl,
    resume,
    run,
    run_calling,
    tiny,
)

import qgs
from qgs.checkpoint.model_file import CheckpointFile
from qgs.train.folder import OtherRunError, RunFolder, read_state, write_state

SCHEDULED = """
model.renderer.dilation={schedule: steps, values: [4, 2, 1], at: [1, 3]}
losses.photometric.ssim_weight={schedule: linear, values: [0.4, 0], at: [0, 4]}
objective.alpha_weight={schedule: steps, values: [0, 1], at: [2]}
optimizer.learning_rate={schedule: cosine, values: [1.0e-3, 0], at: [0, 4]}
optimizer.warmup=2000
"""


class Killed(BaseException):
    """Ends a run as a kill does, from the loop's point of view: nothing is saved any more."""


def resumed(folder, *options):
    """Continue a copy of `trained_run`."""
    return resume(tiny("locus", TRAINED, *options), folder)


def change_counters(folder, **values):
    recipe, states = read_state(folder / "state.safetensors")
    states["counters"] |= values
    write_state(folder / "state.safetensors", recipe.tree, states)


def test_a_stopped_run_goes_on_where_it_and_its_schedules_stopped():
    options = (*TWO, *SCHEDULED.strip().splitlines())
    recipe = tiny("locus", *options, "training.steps=4")
    again = "again.safetensors"
    resume(recipe, "whole")
    seen = []

    def note(trainer, stop):
        loss = trainer.training_pass.losses["photometric"]
        seen.append((trainer.model.renderer.config.dilation, loss.config.ssim_weight))
        if trainer.counters.step == 2:
            stop.append(signal.SIGTERM)

    stopped = run_calling(note, recipe)
    assert stopped.steps == 2
    assert stopped.stopped_by == "SIGTERM"
    qgs.save(qgs.load(stopped.folder.checkpoint), again)
    assert CheckpointFile(again).step == 2
    assert qgs.load(again).renderer.config.dilation == 2
    for other in ("objective.depth_weight=0.5", "losses.photometric.ssim_weight.values=[0.4, 0.1]"):
        must_refuse(other.split("=")[0], resume, tiny("locus", *options, other), kind=OtherRunError)
    assert run_calling(note, recipe, resume=True).resumed_at == 2
    assert_equal_runs("whole", "run")
    # After a step there stand the numbers of the next one.
    assert seen == [(2, pytest.approx(0.3)), (2, 0.2), (1, pytest.approx(0.1)), (1, 0)]
    history = RunFolder("whole").history()
    rates = [5e-4 * (1 + math.cos(math.pi * step / 4)) for step in range(4)]
    assert_near(column(history, "lr"), rates)
    assert_near(history[3]["ssim"], history[0]["ssim"] / 4, rtol=0.2)  # 0.1 is left
    assert [record["alpha_consistency"] > 0 for record in history] == [False, False, True, True]
    terms = "mse ssim visibility anchor_visibility alpha_consistency depth_consistency"
    for record in history:
        assert record["depth_consistency"] > 0
        assert_near(sum(record[term] for term in terms.split()), record["loss"])


def test_a_kill_between_the_first_two_files_loses_nothing(monkeypatch):
    recipe = tiny("tokengs", "training.steps=1", "optimizer.warmup=0")
    with monkeypatch.context() as patch:
        patch.setattr("qgs.train.folder.save", Mock(side_effect=Killed))
        with pytest.raises(Killed):
            run(recipe)
    assert resume(recipe).resumed_at == 1
    assert CheckpointFile("run/checkpoint.safetensors").step == 1


def test_a_longer_budget_goes_on_without_damaged_and_lost_records(copied, caplog):
    files = copied / "history.jsonl", copied / "evaluations.jsonl"
    for file in files:
        file.write_text(f'{{"step": 2, "lo\n[1]\n{file.read_text()}{{"step": 4}}\n')
    in_halves = shutil.copytree(copied, copied.with_name("halves"))
    longer = ("training={steps: 4, evaluate_every: 4}", "evaluation.scenes=1")
    assert resumed(copied, *longer, "training.save_every=7").steps == 4
    history, evaluations = (read_jsonl(file) for file in files)
    assert column(history, "step") == [1, 2, 3, 4]
    assert column(evaluations, "step") == [2, 2, 3, 3, 4, 4]
    for file in files:
        for line in (1, 2):
            assert f"{file}, line {line} is damaged" in caplog.text
    assert "steps: 4" in (copied / "recipe.yaml").read_text()
    last = resumed(in_halves, *longer, "training.accumulate=2").folder.history()[-1]
    for name in ("lr", "loss", "gradient"):
        assert_near(last[name], history[-1][name], rtol=1e-4)


def test_the_clock_goes_on(copied):
    change_counters(copied, seconds=1.0)
    result = resumed(copied, "training={steps: 200, seconds: 1.02, evaluate_every: 0}")
    seconds = column(result.folder.history(), "seconds")
    assert seconds[3] == 1.0
    assert seconds[4] > 1.0
    assert 1.02 <= result.seconds < 10


def test_a_run_killed_before_its_first_save_starts_again(trained_run, copied):
    for file in copied.glob("*.safetensors"):
        file.unlink()
    for name in (".state.safetensors.4711.tmp", ".tmpA9b0zZ"):
        (copied / name).write_text("half a state")
    must_refuse(r"seed: 1 here, 0 in the run", resumed, copied, "seed=1", kind=OtherRunError)
    assert resumed(copied).resumed_at is None
    assert_equal_runs(copied, trained_run.folder.path)
    assert not list(copied.glob(".*"))


def test_a_finished_run_is_left_as_it_is_and_others_are_refused(trained_run, copied):
    before = contents(copied)
    again = resumed(copied)
    assert again.resumed_at == 3
    assert again.steps == 3
    assert again.stopped_by is None
    assert_equal(trained_run.model.state_dict(), again.model.state_dict())
    changes = ("optimizer.learning_rate=1e-3", "seed=4", "training.save_every=3")
    reason = r"rate: 0\.001 here, 0\.0015 in"
    told = str(must_refuse(reason, resumed, copied, *changes, kind=OtherRunError))
    assert "seed: 4 here, 0 in the run" in told
    assert "training.save_every:" not in told
    batches = r"training\.batch_size: 3 here, 2 in the run"
    must_refuse(batches, resumed, copied, "training.batch_size=3", kind=OtherRunError)
    folder = RunFolder(copied)
    folder.take()
    must_refuse("another process is training", resumed, copied, kind=FileExistsError)
    folder.close()
    resumed(copied)
    assert contents(copied) == before
    change_counters(copied, scenes="others")
    must_refuse("training scenes have changed", resumed, copied, kind=OtherRunError)


@pytest.mark.slow
def test_killed_runs_go_on_from_whole_files(monkeypatch):
    """Some kills must come inside a save, for this to prove anything."""
    tool = ROOT / "tools/fuzz.py"
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    told = subprocess.check_output([sys.executable, tool, "kill-training", "--count=12"], text=True)
    assert re.match(r"12 kills, [1-9]\d* of them during a save", told), told

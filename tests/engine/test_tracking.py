"""What trackers are told, and what a person reads while a model trains."""

import io
import json
import re
import sys
import time
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from accelerate import PartialState
from rich.console import Console
from training_runs import Tiny, run, tensorboard_events

from qgs.engine.tracking import Trackers, TrainingProgress

FILE_TRACKER = """
import json
from qgs.engine.tracking import Tracker

class Lines(Tracker):
    def __init__(self, run, options, step):
        self.file = (run / "lines.jsonl").open("w")
        self.log({"width": options["model.width"]}, step)
    def log(self, values, step):
        self.file.write(json.dumps([step, values]) + "\\n")
    def close(self):
        self.file.close()

plugin = Lines
"""


def test_a_distribution_offers_a_tracker_by_an_entry_point(
    tiny: Tiny, tmp_path: Path, install: Callable[..., None]
) -> None:
    install("qgs-lines", "lines", FILE_TRACKER, group="qgs.trackers")
    result = run(tiny("tokengs", "training.trackers=[lines]"), tmp_path / "run")
    lines = [json.loads(line) for line in (tmp_path / "run" / "lines.jsonl").open()]
    assert lines[0] == [0, {"width": 32}]
    losses = [(step, values["loss"]) for step, values in lines[1:]]
    assert losses == [(record["step"], record["loss"]) for record in result.folder.history()]
    with pytest.raises(ValueError, match="lines, tensorboard, wandb"):
        Trackers(("linez",))


FAILING_TRACKER = """
from qgs.engine.tracking import Tracker

class Failing(Tracker):
    def __init__(self, run, options, step):
        self.closed = run / "closed"
        if FAILS == "open":
            raise OSError("no service")
    def log(self, values, step):
        raise OSError("no service")
    def close(self):
        self.closed.touch()

plugin = Failing
"""


@pytest.mark.parametrize("fails", ["open", "log"])
def test_a_tracker_that_fails_is_left_out_and_the_training_goes_on(
    fails: str,
    tiny: Tiny,
    tmp_path: Path,
    install: Callable[..., None],
    caplog: pytest.LogCaptureFixture,
) -> None:
    install("qgs-lines", "lines", FILE_TRACKER, group="qgs.trackers")
    code = f"FAILS = {fails!r}\n{FAILING_TRACKER}"
    install(f"qgs-{fails}-fails", f"{fails}-fails", code, group="qgs.trackers")
    result = run(tiny("tokengs", f"training.trackers=[{fails}-fails, lines]"), tmp_path / "run")
    assert [f"{fails}-fails" in record.message for record in caplog.records].count(True) == 1
    assert (tmp_path / "run" / "closed").exists() == (fails == "log")
    lines = (tmp_path / "run" / "lines.jsonl").read_text().splitlines()
    assert len(lines) == 1 + result.steps


def test_a_resumed_run_takes_back_what_was_told_of_lost_steps(tiny: Tiny, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="the extra `tensorboard` is not installed")
    for first, value in ((1, 1.0), (3, 2.0)):
        tracking = Trackers(("tensorboard",))
        tracking.open(tmp_path, tiny("locus"), step=first - 1)
        for step in range(first, 5):
            tracking.log({"loss": value}, step)
        tracking.close()
        time.sleep(1.1)  # files of one second are read in the order of a number in their names
    events = tensorboard_events(tmp_path).Scalars("loss")
    assert [(e.step, e.value) for e in events] == [(1, 1.0), (2, 1.0), (3, 2.0), (4, 2.0)]


def test_a_resumed_run_goes_on_in_its_run_of_wandb(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wandb = MagicMock(__spec__=ModuleSpec("wandb", None))
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    PartialState(cpu=True)  # accelerate's trackers ask it which process they are in
    for step in (0, 4):
        tracking = Trackers(("wandb",))
        tracking.open(tmp_path, tiny("locus"), step)
        tracking.log({"loss": 0.5}, step + 1)
    first, second = (call.kwargs for call in wandb.init.call_args_list)
    assert first == second
    assert first["id"]
    logged = [call.kwargs["step"] for call in wandb.init.return_value.log.call_args_list]
    assert logged == [1, 5]


def shown(monkeypatch: pytest.MonkeyPatch, *steps: tuple[int, int, float, float]) -> list[str]:
    """The lines for (step, images, seconds, used), each shown."""
    monkeypatch.setattr("qgs.engine.tracking._LOG_SECONDS", 0.0)
    told = io.StringIO()
    console = Console(width=200, file=told)
    with TrainingProgress(console) as bar:
        for step, images, seconds, used in steps:
            assert bar.update(step, 0.1, 20.0, images, seconds, used)
    return [line for line in told.getvalue().splitlines() if line]


def left(line: str) -> str:
    found = re.search(r"(\S+) left", line)
    assert found
    return found[1]


def test_time_left_is_what_the_rest_takes_at_this_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    *_, line = shown(monkeypatch, (1, 8, 0.0, 0.01), (26, 208, 100.0, 0.26))
    assert left(line) == "0:04:56", "0.74 of the budget, 100 s for each 0.25"
    assert "2.0 images/s" in line


def test_a_resumed_run_counts_from_where_it_resumed(monkeypatch: pytest.MonkeyPatch) -> None:
    slow_before = 10_000.0
    first, second = (501, 4008, slow_before, 0.501), (601, 4808, slow_before + 10, 0.601)
    *_, line = shown(monkeypatch, first, second)
    assert left(line) == "0:00:40"
    assert "80 images/s" in line

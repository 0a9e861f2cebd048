"""What trackers are told, and what a person reads while a model trains."""

import sys
import time
from importlib.machinery import ModuleSpec
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from accelerate import PartialState
from tables import must_refuse, names_in, text_console
from training_runs import TRAINED, read_jsonl, resume, run, tiny

from qgs.contracts import MissingExtraError
from qgs.recipe.recipe import flat
from qgs.train.tracking import Trackers, TrainingProgress

FILE_TRACKER = """
import json
from qgs.train.tracking import Tracker

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
FAILING_TRACKER = """
from qgs.train.tracking import Tracker

class Failing(Tracker):
    def __init__(self, run, options, step):
        self.closed = run / "closed"
        if FAILS == "opens":
            raise OSError("no service")
    def log(self, values, step):
        raise OSError("no service")
    def close(self):
        self.closed.write_text(FAILS)

plugin = Failing
"""


def test_distributions_offer_trackers_and_one_that_fails_is_left_out(install, caplog):
    group = {"group": "qgs.trackers"}
    install("qgs-lines", "lines", FILE_TRACKER, **group)
    for name in ("opens", "logs"):
        install(f"qgs-{name}", name, f"FAILS = {name!r}\n{FAILING_TRACKER}", **group)
    result = run(tiny("tokengs", "training.trackers=[opens, logs, lines]"))
    first, *lines = read_jsonl(Path("run/lines.jsonl"))
    assert first == [0, {"width": 32}]
    assert lines == [[record["step"], record] for record in result.folder.history()]
    opens, logs = (record.message for record in caplog.records)
    assert " opens " in opens
    assert " logs " in logs
    assert Path("run/closed").read_text() == "logs"


def test_a_missing_tracker_is_told_before_anything_is_made(here, monkeypatch):
    must_refuse("tensorboard, wandb", Trackers, ("linez",))
    monkeypatch.setattr("qgs.train.tracking.find_spec", lambda name: None)
    recipe = tiny("tokengs", "training.trackers=[tensorboard]")
    must_refuse("pip install tensorboard", run, recipe, kind=MissingExtraError)
    assert not names_in(here)


def test_tensorboard_gets_what_the_history_gets_and_drops_what_was_lost(copied):
    """Of a resumed run: as if it had been told of steps that came after the last save."""
    name = "tensorboard.backend.event_processing.event_accumulator"
    module = pytest.importorskip(name, reason="the extra `tensorboard` is not installed")
    recipe = tiny("locus", TRAINED, "training={trackers: [tensorboard], steps: 4}")
    lost = Trackers(("tensorboard",))
    lost.open(copied, flat(recipe.tree), 0)
    for step in range(1, 6):
        lost.tell(lambda tracker, step=step: tracker.log({"loss": float(step)}, step))
    lost.close()
    time.sleep(1.1)  # files of one second are read in the order of a number in their names
    last = resume(recipe, copied).folder.history()[-1]
    events = module.EventAccumulator(str(copied / "tensorboard")).Reload()
    told = [(event.step, event.value) for event in events.Scalars("loss")]
    assert told == [(1, 1.0), (2, 2.0), (3, 3.0), (4, pytest.approx(last["loss"]))]
    for name in ("lr", "evaluation/raw/psnr", "evaluation/ema/ssim"):
        assert [event.step for event in events.Scalars(name)] == [4]
    assert len(events.Images("evaluation")) == 1


def test_a_resumed_run_goes_on_in_its_run_of_wandb(tmp_path, monkeypatch):
    wandb = MagicMock(__spec__=ModuleSpec("wandb", None))
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    PartialState(cpu=True)  # accelerate's trackers ask it which process they are in
    for step in (0, 4):
        trackers = Trackers(("wandb",))
        trackers.open(tmp_path, {}, step)
        trackers.tell(lambda tracker, step=step: tracker.log({"loss": 0.5}, step + 1))
    first, second = (call.kwargs["id"] for call in wandb.init.call_args_list)
    assert first == second != ""
    assert [call.kwargs["step"] for call in wandb.init.return_value.log.call_args_list] == [1, 5]


def test_a_line_tells_how_much_of_the_budget_is_used():
    console = text_console()
    with TrainingProgress(console) as bar:
        bar.show(501, 0.1, 20.0, 0.501)
        bar.show(502, 0.1, 20.0, 0.502)  # a moment later
    assert console.file.getvalue() == "step 501  loss 0.1000  PSNR 20.00  budget 50.1%\n"

"""Two processes on one machine train the model that one would train; which device `auto` takes."""

import signal
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
import yaml
from training_runs import TWO, column, losses, parts_of, read_jsonl, run, run_calling, tiny
from two_processes import told_by_two

from qgs.train import distributed
from qgs.train.training import ELSEWHERE

PARTS = 'optimizer.parts={"decoder.0.feed_forward": 0, "head": 0.5}'
"""One sublayer stays as it is, and the head learns slower."""
NO_LAYERS = (
    "model.decoder={depth: 0, cross_attention: null, self_attention: null, feed_forward: null, "
    "refinement: null, layer_scale: 5.0e-5}",
    "model.supervision.layers=[0]",
)


def train_in_two_processes(*arguments):
    """As `told_by_two`; both processes must have the same weights."""
    (*first, total), second = told_by_two(*arguments)
    assert first == [True, 3]
    assert second == (False, 3, total)


def test_two_processes_continue_what_one_began():
    recipe = tiny("locus", "training.ema=0.9", PARTS)
    run(recipe, "alone")
    assert run_calling(lambda _, stop: stop.append(signal.SIGINT), recipe).steps == 1
    train_in_two_processes(recipe, "run")
    assert losses() == pytest.approx(losses("alone"), abs=1e-5)
    ours = parts_of()
    theirs = parts_of("alone")
    for name in ("weights", "moments", "ema", "good"):
        torch.testing.assert_close(ours[name], theirs[name], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("locus", (*TWO, "training={batch_size: 4, accumulate: 2}")),
        ("tokengs", NO_LAYERS),  # keys that nothing reads
    ],
)
@pytest.mark.slow
def test_two_processes_have_the_loss_curve_of_one(name, options):
    run(tiny(name, *options), "alone")
    train_in_two_processes(tiny(name, *options, "training.render_views=1"), "run")
    assert losses() == pytest.approx(losses("alone"), abs=1e-5)


def test_all_processes_leave_out_a_step_that_one_found_bad(here):
    options = "{on_nonfinite: skip, render_views: 1, ema: 0.9, evaluate_every: 2}"
    train_in_two_processes(tiny("locus", f"training={options}"), here, {3}, True)
    records = read_jsonl(here / "history.jsonl")
    assert ["loss" in record for record in records] == [True, False, True]
    assert column(read_jsonl(here / "evaluations.jsonl"), "step") == [2, 2, 3, 3]


@pytest.mark.parametrize(("bad", "steps"), [(1, 0), (3, 1)], ids=["first", "later"])
@pytest.mark.slow
def test_two_processes_stop_together_at_a_sample_that_one_cannot_make_or_leave_it_out(bad, steps):
    """Samples with odd numbers are those of the second process."""
    errors = told_by_two(tiny("locus"), "run", {bad})
    reason = f"scene 'x', frame {bad} (a.png): cannot be read"
    for error, cause in zip(errors, (ELSEWHERE, reason), strict=True):
        assert error.startswith(f"{cause}; ")
        assert (f"saved at step {steps}; continue with --resume" in error) == bool(steps)
    assert Path("run").exists() == bool(steps)
    told_by_two(tiny("locus", "training.on_bad_sample=skip"), "run", {bad})
    assert len(losses()) == 3


DEVICES = """
- [auto, false, null, cpu, 0]
- [auto, false, true, cpu, 0]
- [auto, true, null, cpu, 1]
- [auto, true, true, cuda, 0]
- [cpu, true, true, cpu, 0]
- [cuda, true, null, cuda, 0]
"""
"""The option, CUDA, gsplat, the device that is taken, how many lines are said."""


def test_the_device_and_what_is_said(monkeypatch):
    for wanted, cuda, gsplat, expected, told in yaml.safe_load(DEVICES):
        monkeypatch.setattr(torch.cuda, "is_available", Mock(return_value=cuda))
        monkeypatch.setattr(distributed, "find_spec", Mock(return_value=gsplat))
        said = []
        assert distributed.choose_device(wanted, said.append) == expected
        assert ["gsplat" in line for line in said] == [True] * told

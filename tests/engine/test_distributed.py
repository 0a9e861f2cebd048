"""Two processes on one machine train the model that one would train."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file
from training_runs import TWO, Tiny, losses, read_jsonl, run, run_calling

from qgs.composer import Recipe
from qgs.engine.distributed import StopRequest
from qgs.engine.folder import read_state
from qgs.engine.training import ELSEWHERE, Trainer

WORKER = Path(__file__).with_name("distributed.py")
PARTS = 'optimizer.parts={"decoder.0.feed_forward": 0, "head": 0.5}'
"""One sublayer stays as it is, and the head learns slower."""


def told_by_two(recipe: Recipe, run: Path, spoil: str = "") -> str:
    """Continue or start `run` by torchrun; what both processes print."""
    file = run.with_suffix(".yaml")
    file.write_text(yaml.safe_dump(dict(recipe.tree)))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    done = subprocess.run(
        [*command, str(WORKER), str(file), str(run), spoil],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def train_in_two_processes(recipe: Recipe, run: Path, spoil: str = "") -> None:
    """As `told_by_two`; both processes must say the same of the run."""
    told = told_by_two(recipe, run, spoil)
    # wherever they stand: what libraries print meanwhile lands in the same lines
    said = re.findall(r"(True|False) (\d+) (\d+\.\d+)", told)
    assert sorted(main for main, *_ in said) == ["False", "True"]
    assert said[0][1:] == said[1][1:] == ("4", said[0][2]), "the same weights everywhere"


@pytest.mark.slow
@pytest.mark.parametrize("accumulate", [1, 2])
def test_two_processes_have_the_loss_curve_of_one(
    tiny: Tiny, tmp_path: Path, accumulate: int
) -> None:
    options = ("training.save_every=2", f"training.accumulate={accumulate}", PARTS)
    recipe = tiny("locus", "training.batch_size=4", *options)
    run(recipe, tmp_path / "alone")
    train_in_two_processes(recipe, tmp_path / "two")
    assert losses(tmp_path / "two") == pytest.approx(losses(tmp_path / "alone"), abs=1e-5)
    names = {path.name for path in (tmp_path / "two").iterdir()}
    assert names == {
        "recipe.yaml", "history.jsonl", "checkpoint.safetensors", "state.safetensors"
    }  # fmt: skip


NO_LAYERS = (
    "model.decoder={depth: 0, cross_attention: null, self_attention: null, feed_forward: null, "
    "refinement: null, layer_scale: 5.0e-5}",
    "model.supervision.layers=[0]",
)


@pytest.mark.slow
def test_two_processes_train_a_model_whose_keys_nothing_reads(tiny: Tiny, tmp_path: Path) -> None:
    train_in_two_processes(tiny("tokengs", *NO_LAYERS), tmp_path / "two")


def test_two_processes_continue_what_one_began(tiny: Tiny, tmp_path: Path) -> None:
    options = ("training.batch_size=2", "training.save_every=2", "training.ema=0.9", PARTS)
    recipe = tiny("locus", *options)
    run(recipe, tmp_path / "alone")

    def kill(trainer: Trainer, stop: StopRequest) -> None:
        if trainer.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_calling(kill, recipe, tmp_path / "two")
    train_in_two_processes(recipe, tmp_path / "two")
    assert losses(tmp_path / "two") == pytest.approx(losses(tmp_path / "alone"), abs=1e-5)
    ours, theirs = (
        read_state(tmp_path / name / "state.safetensors").parts for name in ("two", "alone")
    )
    for name in ("weights", "moments", "ema", "good"):
        assert ours[name].keys() == theirs[name].keys()
        for key, value in ours[name].items():
            if key != "keys":  # names, which the line above compares
                torch.testing.assert_close(value, theirs[name][key], rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_two_processes_make_two_passes_as_one_does(tiny: Tiny, tmp_path: Path, two: None) -> None:
    alone = tiny("locus", *TWO, "training.batch_size=2")
    run(alone, tmp_path / "alone")
    pair = tiny("locus", *TWO, "training.batch_size=2", "training.render_views=1")
    train_in_two_processes(pair, tmp_path / "two")
    assert losses(tmp_path / "two") == pytest.approx(losses(tmp_path / "alone"), abs=1e-5)


@pytest.mark.slow
def test_all_processes_leave_out_a_step_that_one_found_bad(tiny: Tiny, tmp_path: Path) -> None:
    parts = ("training.batch_size=2", "training.render_views=1", "training.on_nonfinite=skip")
    judged = ("training.ema=0.9", "training.evaluate_every=2", "evaluation.scenes=1")
    train_in_two_processes(tiny("locus", *parts, *judged), tmp_path / "run", "spoil")
    run = tmp_path / "run"
    records = read_jsonl(run / "history.jsonl")
    assert ["loss" in record for record in records] == [True, False, True, True]
    incident = run / "incidents" / "step-2"
    report = json.loads((incident / "report.json").read_text())
    first = {found["process"]: found["first"] for found in report["found"]}
    assert first[0] is None
    assert first[1]["tensor"] == "targets.images"
    seen = [load_file(incident / f"batch{n}.safetensors")["targets.images"] for n in ("", "-1")]
    assert [int(images.isnan().sum()) for images in seen] == [0, 1]
    judged = read_jsonl(run / "evaluations.jsonl")
    assert [(record["step"], record["weights"]) for record in judged] == [
        (step, weights) for step in (2, 4) for weights in ("raw", "ema")
    ]


@pytest.mark.slow
@pytest.mark.parametrize(("bad", "steps"), [(1, 0), (5, 2)], ids=["first", "later"])
def test_two_processes_stop_together_at_a_sample_that_one_cannot_make(
    tiny: Tiny, tmp_path: Path, bad: int, steps: int
) -> None:
    """Samples with odd numbers are those of the second process."""
    recipe = tiny("locus", "training.batch_size=2")
    told = told_by_two(recipe, tmp_path / "run", str(bad))
    assert told.count("refused: ") == 2
    assert told.count(f"refused: scene 'x', frame {bad} (a.png): cannot be read") == 1
    assert told.count(f"refused: {ELSEWHERE}") == 1
    assert told.count(f"saved at step {steps}; continue with --resume") == 2 * bool(steps)
    assert (tmp_path / "run").exists() == bool(steps)


@pytest.mark.slow
@pytest.mark.parametrize("bad", [1, 5])
def test_two_processes_go_on_without_a_sample_that_one_cannot_make(
    tiny: Tiny, tmp_path: Path, bad: int
) -> None:
    recipe = tiny("locus", "training.batch_size=2", "training.on_bad_sample=skip")
    told = told_by_two(recipe, tmp_path / "run", str(bad))
    assert told.count(f"left out: 1 times scene 'x', frame {bad}") == 2
    assert len(losses(tmp_path / "run")) == 4

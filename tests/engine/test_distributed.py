"""Two processes on one machine train the model that one would train."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from training_runs import Tiny, losses, run, run_calling

import qgs
from qgs.composer import Recipe
from qgs.engine.checkpoint import read_state
from qgs.engine.distributed import StopRequest
from qgs.engine.training import Trainer

WORKER = Path(__file__).with_name("distributed.py")
FSDP = {"ACCELERATE_USE_FSDP": "true"}
"""What `accelerate launch --use_fsdp` tells its processes."""
PARTS = 'optimizer.parts={"decoder.0.feed_forward": 0, "head": 0.5}'
"""One sublayer stays as it is, and the head learns slower."""


def train_in_two_processes(recipe: Recipe, run: Path, **environment: str) -> list[list[str]]:
    """Continue or start `run` by torchrun; what each process said of it."""
    file = run.with_suffix(".yaml")
    file.write_text(yaml.safe_dump(dict(recipe.tree)))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    done = subprocess.run(
        [*command, str(WORKER), str(file), str(run)],
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    # wherever they stand: what libraries print meanwhile lands in the same lines
    return [list(words) for words in re.findall(r"(True|False) (\d+) (\d+\.\d+)", done.stdout)]


@pytest.mark.parametrize("accumulate", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_two_processes_have_the_loss_curve_of_one(
    tiny: Tiny, tmp_path: Path, accumulate: int
) -> None:
    options = ("training.save_every=2", f"training.accumulate={accumulate}", PARTS)
    alone = tiny("locus", "training.batch_size=2", *options)
    run(alone, tmp_path / "alone")
    said = train_in_two_processes(
        tiny("locus", "training.batch_size=1", *options), tmp_path / "two"
    )
    assert sorted(main for main, *_ in said) == ["False", "True"]
    assert said[0][1:] == said[1][1:] == ["4", said[0][2]], "the same weights everywhere"
    assert losses(tmp_path / "two") == pytest.approx(losses(tmp_path / "alone"), abs=1e-5)
    names = {path.name for path in (tmp_path / "two").iterdir()}
    assert names == {
        "recipe.yaml", "history.jsonl", "checkpoint.safetensors", "state.safetensors"
    }  # fmt: skip


@pytest.mark.parametrize("accumulate", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_shards_continue_what_one_process_began(
    tiny: Tiny, tmp_path: Path, accumulate: int
) -> None:
    options = ("training.save_every=2", "training.ema=0.9", PARTS)
    alone = tiny("locus", "training.batch_size=4", *options)
    run(alone, tmp_path / "alone")
    begin(alone, tmp_path / "shards")
    part = f"training.batch_size={2 // accumulate}", f"training.accumulate={accumulate}"
    said = train_in_two_processes(tiny("locus", *part, *options), tmp_path / "shards", **FSDP)
    assert said[0][1:] == said[1][1:] == ["4", said[0][2]]
    assert losses(tmp_path / "shards") == pytest.approx(losses(tmp_path / "alone"), abs=1e-5)
    ours, theirs = (
        read_state(tmp_path / n / "state.safetensors").parts for n in ("shards", "alone")
    )
    for name in ("weights", "moments", "ema", "good"):
        assert ours[name].keys() == theirs[name].keys()
        for key, tensor in ours[name].items():
            torch.testing.assert_close(tensor, theirs[name][key], rtol=1e-3, atol=1e-4)
    qgs.load(tmp_path / "shards" / "checkpoint.safetensors")


def begin(recipe: Recipe, folder: Path) -> None:
    """The first two steps of a run, killed in the third."""

    def kill(trainer: Trainer, stop: StopRequest) -> None:
        if trainer.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_calling(kill, recipe, folder)

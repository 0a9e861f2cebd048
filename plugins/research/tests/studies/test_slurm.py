"""The Slurm job of the examples, run without Slurm."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import sets

ROOT = Path(__file__).parents[4]


@pytest.mark.slow
def test_a_slurm_job_saves_at_the_signal_and_goes_on(tmp_path):
    """Two processes by torchrun; the script needs of Slurm no more than `scontrol`."""
    out = tmp_path / "run"
    asked = tmp_path / "asked"
    words = sets(
        "data.image_size=[32, 32]",
        "views.targets=2",
        "evaluation.scenes=2",
        "training={seconds: null, steps: 300, save_every: 0, batch_size: 2}",
        "optimizer.warmup=1",
    )
    stub = tmp_path / "bin/scontrol"
    stub.parent.mkdir()
    stub.write_text(f'#!/bin/sh\necho "$@" >> {asked}\n')
    stub.chmod(0o755)
    paths = f"{stub.parent}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    of_slurm = {"SLURM_JOB_ID": "7", "SLURM_GPUS_ON_NODE": "2"}
    environment = {**os.environ, **of_slurm, "PATH": paths, "OMP_NUM_THREADS": "1"}
    recipe = ROOT / "recipes/tiny/locus.yaml"
    script = ["bash", ROOT / "docs/examples/train_8_gpus.sh", recipe, "--out", out]
    command = [*script, "--device", "cpu", *words]
    history = out / "history.jsonl"
    job = subprocess.Popen(command, env=environment)
    while not history.exists() or len(history.read_bytes().splitlines()) < 3:
        assert job.poll() is None  # the training ended too early
        time.sleep(0.1)
    job.terminate()
    job.wait(60)
    assert asked.read_text() == "requeue 7\n"
    assert len(history.read_bytes().splitlines()) < 300
    assert (out / "state.safetensors").exists()
    assert subprocess.run(command, env=environment, timeout=200).returncode == 0
    assert len(history.read_bytes().splitlines()) == 300
    assert (out / "evaluation/summary.json").exists()

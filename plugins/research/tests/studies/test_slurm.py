"""A Slurm job of a training, run without Slurm."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import done, run_qgs, sets

RECIPE = Path(__file__).parents[4] / "recipes/tiny/locus.yaml"


def test_a_slurm_job_is_that_of_the_example(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    index = tmp_path / "datasets/re10k/evaluation_2views.json"
    index.parent.mkdir(parents=True)
    index.write_text('{"a": {"context": [0, 2], "target": [1]}}')
    words = ("locus/re10k.yaml", "--out", "runs/locus", "--set", "training.workers=7")
    done("slurm", "train", *words, "--gpus", "8")
    script = (tmp_path / "runs/locus.slurm.sh").read_text()
    shown = script.replace(sys.executable, "python").replace(str(tmp_path), ".")
    assert shown == (RECIPE.parents[2] / "docs/examples/train_8_gpus.sh").read_text()
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["locus.slurm.sh"]
    with pytest.raises(ValueError, match=r"training\.batch_size"):
        done("slurm", "train", *words, "--gpus", "5")
    mistaken = run_qgs("slurm", "train", *words, "--gpu", "8")
    assert mistaken.exit_code == 2
    assert "No such option: --gpu" in mistaken.output


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
    done("slurm", "train", RECIPE, "--out", out, "--gpus", "2", "--device", "cpu", *words)
    stub = tmp_path / "bin/scontrol"
    stub.parent.mkdir()
    stub.write_text(f'#!/bin/sh\necho "$@" >> {asked}\n')
    stub.chmod(0o755)
    paths = f"{stub.parent}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": paths, "SLURM_JOB_ID": "7", "OMP_NUM_THREADS": "1"}
    command = ["bash", str(tmp_path / "run.slurm.sh")]
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

"""Jobs for Slurm, without Slurm."""

import os
import subprocess
import time

import pytest
from commands import done, run_qgs, sets
from tables import must_not_find, must_refuse, names_in

RECIPE = "tiny/locus.yaml"


def test_a_job_has_the_words_of_the_command_and_wrong_ones_are_refused(here):
    line = f"slurm train {RECIPE}"
    more = sets("training.workers=3", "training.batch_size=8")
    done(line, *more, "--gpus", 2, "--out", "my runs/a", "--threads", 2)
    script = (here / "my runs/a.slurm.sh").read_text()
    assert "--cpus-per-task=10\n#SBATCH --gpus-per-node=2\n" in script
    assert f"cd {here} || exit\n" in script
    assert f"--output='{here}/my runs/a.slurm-%j.log'\n" in script
    assert "training.batch_size=8 --out 'my runs/a' --threads 2 --resume & job=$!\n" in script
    must_refuse(r"training\.batch_size", done, f"{line} --out b --gpus 3", *more)
    must_not_find(
        "nowhere", done, f"{line} --out b", *more, *sets("data={type: qgs/photos, path: nowhere}")
    )
    assert run_qgs(f"{line} --out b --gpu 2", *more).exit_code == 2
    assert names_in(here) == {"my runs"}


def steps_in(history):
    return len(history.read_bytes().splitlines())


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
    done(f"slurm train {RECIPE} --out {out} --gpus 2 --device cpu", *words)
    stub = tmp_path / "bin/scontrol"
    stub.parent.mkdir()
    stub.write_text(f'#!/bin/sh\necho "$@" >> {asked}\n')
    stub.chmod(0o755)
    paths = f"{stub.parent}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": paths, "SLURM_JOB_ID": "7", "OMP_NUM_THREADS": "1"}
    command = ["bash", tmp_path / "run.slurm.sh"]
    history = out / "history.jsonl"
    job = subprocess.Popen(command, env=environment)
    while not history.exists() or steps_in(history) < 3:
        assert job.poll() is None  # the training ended too early
        time.sleep(0.1)
    job.terminate()
    job.wait(60)
    assert asked.read_text() == "requeue 7\n"
    assert steps_in(history) < 300
    assert (out / "state.safetensors").exists()
    assert subprocess.run(command, env=environment, timeout=200).returncode == 0
    assert steps_in(history) == 300
    assert (out / "evaluation/summary.json").exists()

"""Nothing is lost when training is killed at any moment, inside a save too."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "tools" / "kill_training.py"


@pytest.mark.parametrize(
    ("kills", "options"),
    [
        (2, ("--width=64", "--steps=12", "--longest=0.2")),
        pytest.param(50, ("--width=192", "--steps=150"), marks=pytest.mark.slow),
    ],
)
def test_killed_runs_go_on_from_whole_files(kills: int, options: tuple[str, ...]) -> None:
    done = subprocess.run(
        [sys.executable, str(TOOL), f"--kills={kills}", *options],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith(f"{kills} kills")

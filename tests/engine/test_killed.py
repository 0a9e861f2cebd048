"""Nothing is lost when training is killed at any moment, inside a save too."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "tools" / "kill_training.py"


@pytest.mark.parametrize(
    ("kills", "inside", "options"),
    [
        (2, 0, ("--width=64", "--steps=12", "--longest=0.2")),
        pytest.param(50, 1, ("--width=192", "--steps=150"), marks=pytest.mark.slow),
    ],
)
def test_killed_runs_go_on_from_whole_files(
    kills: int, inside: int, options: tuple[str, ...]
) -> None:
    """inside: how many kills, at least, must have come inside a save for this to prove anything."""
    done = subprocess.run(
        [sys.executable, str(TOOL), f"--kills={kills}", *options],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=1200 if inside else 240,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = re.match(r"(\d+) kills, (\d+) inside a save", done.stdout)
    assert found, done.stdout
    assert int(found[1]) == kills
    assert int(found[2]) >= inside

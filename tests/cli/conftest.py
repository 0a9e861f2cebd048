"""A run of `qgs train` made once, and pictures so small that a reconstruction takes no time."""

from pathlib import Path

import numpy as np
import pytest
from commands import done, run_qgs, sets

from qgs.reconstruction import saving

RECIPE = Path(__file__).parents[2] / "recipes/tiny/locus.yaml"
QUICK = sets(
    "data.image_size=[32, 32]",
    "views.targets=2",
    "evaluation.scenes=2",
    "training.seconds=77",
    "training.steps=2",
    "optimizer.warmup=1",
)


@pytest.fixture(scope="session")
def training():
    """A function: train a tiny model for two steps into a folder, with these words more."""
    return lambda out, *words: run_qgs("train", RECIPE, "--out", out, *QUICK, *words)


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """What that printed and its folder, which no test changes."""
    out = tmp_path_factory.mktemp("trained") / "run"
    return done("train", RECIPE, "--out", out, *QUICK).output, out


@pytest.fixture
def short_orbit(monkeypatch):
    monkeypatch.setattr(saving, "ORBIT_FRAMES", 2)
    monkeypatch.setattr(saving, "ORBIT_SIDE", 16)


@pytest.fixture
def small_pictures(monkeypatch, short_orbit):
    """Overview and orbit are most of the work of saving; one test looks at a real one."""
    monkeypatch.setattr(saving, "overview", lambda result: np.zeros((4, 4, 3), np.uint8))

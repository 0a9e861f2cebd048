"""A run of `qgs train` made once."""

import pytest
from commands import done, run_qgs, sets
from reconstructing import checkpoint, photos

__all__ = ["checkpoint", "photos"]

RECIPE = "tiny/locus.yaml"
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

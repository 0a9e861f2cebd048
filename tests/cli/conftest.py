"""A run of `qgs train` made once."""

import pytest
from commands import done, run_qgs, sets
from reconstructing import checkpoint, photos

__all__ = ["checkpoint", "photos"]

LINE = "train tiny/locus.yaml --out"
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
    """A function: train a tiny model for two steps into a folder, and words more."""
    return lambda line: run_qgs(f"{LINE} {line}", *QUICK)


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """What that printed and its folder, which no test changes."""
    out = tmp_path_factory.mktemp("trained") / "run"
    return done(LINE, out, *QUICK).output, out

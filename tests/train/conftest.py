"""A run that is trained once."""

import shutil
from pathlib import Path

import pytest
from training_runs import trained_run

__all__ = ["trained_run"]


@pytest.fixture(autouse=True)
def few_samples_measured(monkeypatch):
    """Fewer yet than elsewhere: nothing here reads the ranges of the views."""
    monkeypatch.setattr("qgs.data.stream.MEASURED", 8)


@pytest.fixture
def copied(trained_run, tmp_path):
    """A copy of the folder of `trained_run`."""
    return Path(shutil.copytree(trained_run.folder.path, tmp_path / "copied"))

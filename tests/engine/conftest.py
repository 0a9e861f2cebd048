"""A run that is trained once, and a plugin with an objective of two passes."""

import shutil
import sys
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


@pytest.fixture
def two(install, monkeypatch):
    """The plugin of two_passes.py, installed for this process and for those that it starts."""
    install("qgs-two", "two", Path(__file__).with_name("two_passes.py").read_text())
    monkeypatch.setenv("PYTHONPATH", sys.path[0])

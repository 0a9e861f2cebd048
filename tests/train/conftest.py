"""A run that is trained once."""

import shutil

import pytest
from training_runs import trained_run

__all__ = ["trained_run"]


@pytest.fixture(autouse=True)
def _in_an_empty_folder(here):
    """Runs are trained into `run` there, unless a test says otherwise."""


@pytest.fixture
def copied(trained_run, tmp_path):
    """A copy of the folder of `trained_run`."""
    return shutil.copytree(trained_run.folder.path, tmp_path / "copied")

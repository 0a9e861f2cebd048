"""Sound data sets, and copies of them to plant faults in."""

import shutil

import pytest
from planted import FRAMES, Copy, good_sets
from textured_room import walk


@pytest.fixture(scope="session")
def shots():
    return walk(FRAMES)


@pytest.fixture(scope="session")
def good(tmp_path_factory, shots):
    root = tmp_path_factory.mktemp("good")
    good_sets(root, shots)
    return root


@pytest.fixture
def room(good, tmp_path) -> Copy:
    return Copy(shutil.copytree(good / "room", tmp_path / "room"))


@pytest.fixture
def chunks(good, tmp_path) -> Copy:
    return Copy(shutil.copytree(good / "chunks", tmp_path / "chunks"))


@pytest.fixture
def archives(good, tmp_path) -> Copy:
    return Copy(shutil.copytree(good / "archives", tmp_path / "archives"))

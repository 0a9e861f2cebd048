"""Sound data sets, and copies of them to plant faults in."""

import shutil

import pytest
from installing import install
from planted import FRAMES, Copy, good_sets
from textured_room import walk

__all__ = ["install"]


@pytest.fixture(scope="session")
def shots():
    return walk(FRAMES)


@pytest.fixture(scope="session")
def good(tmp_path_factory, shots):
    root = tmp_path_factory.mktemp("good")
    good_sets(root, shots)
    return root


def copy_of(name: str):
    @pytest.fixture
    def copied(good, tmp_path) -> Copy:
        return Copy(shutil.copytree(good / name, tmp_path / name))

    return copied


room, chunks, archives = map(copy_of, ("room", "chunks", "archives"))

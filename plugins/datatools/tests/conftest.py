"""Sound data sets, and copies of them to plant faults in."""

import shutil

import numpy as np
import pytest
from installing import install
from planted import FRAMES, Copy, good_sets
from qgs_datatools import geometry
from qgs_datatools.epipolar import Features, detect
from textured_room import walk

__all__ = ["install"]


@pytest.fixture(scope="session", autouse=True)
def features_are_detected_once():
    """Most tests have the same photos; features of one take half a second."""
    known: dict[bytes, Features] = {}

    def detected(picture: np.ndarray) -> Features:
        key = picture.tobytes()
        if key not in known:
            known[key] = detect(picture)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(geometry, "detect", detected)
        yield


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

"""Sound data sets, and copies of them to plant faults in."""

import shutil

import pytest
from planted import Planted, good_sets
from qgs_photos.datatools import geometry
from textured_room import walk


def once(make, key):
    known = {}

    def made(*given):
        which = key(*given)
        if which not in known:
            known[which] = make(*given)
        return known[which]

    return made


@pytest.fixture(scope="session", autouse=True)
def photos_are_matched_once():
    """Most tests have the same photos; features of one take a tenth of a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(geometry, "detect", once(geometry.detect, lambda photo: photo.tobytes()))
        patch.setattr(geometry, "match", once(geometry.match, lambda *both: (*map(id, both),)))
        yield


@pytest.fixture(scope="session")
def shots():
    return walk(6)


@pytest.fixture(scope="session")
def good(tmp_path_factory, shots):
    root = tmp_path_factory.mktemp("good")
    good_sets(root, shots)
    return root


@pytest.fixture
def planted(shots, tmp_path):
    return Planted(shots, tmp_path / "planted")


@pytest.fixture
def room(good, tmp_path):
    return shutil.copytree(good / "room", tmp_path / "room")


@pytest.fixture
def chunks(good, tmp_path):
    return shutil.copytree(good / "chunks", tmp_path / "chunks")

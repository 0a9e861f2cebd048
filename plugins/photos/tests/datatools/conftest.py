"""Sound data sets, and copies of them to plant faults in."""

import shutil

import pytest
from planted import HASH, Planted, Room, record, save
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
    """A nerfstudio folder, chunks with two scenes and an index, and an archive, all sound."""
    root = tmp_path_factory.mktemp("good")
    Room(shots).write(root / "room")
    shutil.make_archive(str(root / "archives" / HASH), "zip", root / "room")
    save(root / "chunks/test/0.torch", [record("a", shots), record("b", shots[:3])])
    (root / "chunks/test/index.json").write_text('{"a": "0.torch", "b": "0.torch"}')
    (root / "chunks/evaluation.json").write_text(
        '{"a": {"context": [0, 5], "target": [2]}, "b": {"context": [0, 2], "target": [1]}}'
    )
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

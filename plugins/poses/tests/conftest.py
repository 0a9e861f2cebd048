"""A textured room, photographed while walking, and the poses that COLMAP finds of it."""

from pathlib import Path

import pytest
import textured_room
from PIL import Image
from qgs_poses.making import Made, Options, make_poses
from textured_room import Shot
from walked import PHOTOS, SCALE, quiet


def larger_walk(patch: pytest.MonkeyPatch) -> list[Shot]:
    for name in ("SIZE", "INTRINSICS"):
        larger = tuple(SCALE * number for number in getattr(textured_room, name))
        patch.setattr(textured_room, name, larger)
    return textured_room.walk(PHOTOS)


@pytest.fixture(scope="session")
def shots() -> list[Shot]:
    with pytest.MonkeyPatch.context() as patch:
        return larger_walk(patch)


@pytest.fixture(scope="session")
def walk(shots, tmp_path_factory) -> Path:
    """A folder of the photos alone."""
    folder = tmp_path_factory.mktemp("walk") / "Küche und Flur"
    folder.mkdir()
    for number, shot in enumerate(shots):
        Image.fromarray(shot.image).save(folder / f"{number}.jpg", quality=95, subsampling=0)
    return folder


@pytest.fixture(scope="session")
def made(walk, tmp_path_factory) -> Made:
    return make_poses(walk, tmp_path_factory.mktemp("made") / "poses", Options(), quiet())


@pytest.fixture
def from_one_place(shots, monkeypatch) -> list[Shot]:
    """Photos of the same room, taken without a step."""
    poses = [shot.c2w.copy() for shot in shots]
    for pose in poses:
        pose[:3, 3] = 0
    monkeypatch.setattr(textured_room, "_poses", lambda count: poses)
    return larger_walk(monkeypatch)

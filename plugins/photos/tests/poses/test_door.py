"""Photos without cameras and videos, wherever a command takes photos."""

import re
import shutil
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from photo_formats import opened
from qgs_photos.poses import door, making
from qgs_photos.poses.photos import PosesError
from walked import PHOTOS

import qgs


@pytest.fixture
def calls(made, monkeypatch):
    """Each time that poses are made; what COLMAP finds is there already."""
    calls = []

    folder, poses = made

    def found(source, out, working, *rest):
        calls.append(source)
        time.sleep(0.2)
        for part in ("images", "sparse"):
            shutil.copytree(folder / part, out / part)
        return poses

    monkeypatch.setattr(making, "_made", found)
    return calls


@pytest.fixture
def folder(walk, calls, tmp_path):
    """A copy of the walk."""
    return shutil.copytree(walk, tmp_path / "holiday")


def photos_of(folder):
    """Photos as a command opens them."""
    return qgs.read_photos(folder, size=(8, 12)).images


def test_poses_are_made_once_and_kept_beside_the_photos(folder, calls):
    for _ in range(2):
        assert photos_of(folder).shape[1] == PHOTOS
    assert len(calls) == 1
    beside = folder.parent / "holiday_poses"
    assert (beside / "sparse/0").is_dir()
    assert {*folder.parent.iterdir()} == {folder, beside}
    (folder / "1.jpg").unlink()  # other photos are not mixed up
    with pytest.raises(PosesError, match="holiday_poses"):
        photos_of(folder)


def test_a_training_makes_none(folder, calls):
    with pytest.raises(FileNotFoundError, match="Make some by `qgs poses`"):
        opened(folder).scenes("train")
    assert not calls


def test_a_folder_of_something_else_is_not_written_into(folder):
    notes = folder.parent / "holiday_poses/mine.txt"
    notes.parent.mkdir()
    notes.touch()
    with pytest.raises(FileExistsError):
        photos_of(folder)
    assert [*notes.parent.iterdir()] == [notes]


def test_a_folder_whose_photos_are_elsewhere_is_none(tmp_path):
    (tmp_path / "a/b").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match="lists no cameras"):
        photos_of(tmp_path / "a")


def test_of_several_calls_at_once_one_makes_them_and_the_others_wait(folder, calls):
    with ThreadPoolExecutor(3) as pool:
        found = [*pool.map(door.posed_folder, [folder] * 3)]
    assert found == [door.beside(folder)] * 3
    assert len(calls) == 1


def test_a_read_only_place_names_the_command_for_another(folder, monkeypatch):
    def refused(*rest, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(door, "FileLock", refused)
    with pytest.raises(OSError, match=re.escape(f"qgs poses {folder} --out")):
        door.posed_folder(folder)

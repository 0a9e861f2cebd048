"""Photos without cameras and videos, wherever qgs takes photos."""

import re
import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from commands import run_qgs
from photo_formats import opened
from qgs_photos.poses import door, making
from qgs_photos.poses.making import locked
from qgs_photos.poses.photos import PosesError
from walked import PHOTOS


@pytest.fixture
def calls(made, monkeypatch):
    """Each time that poses are made; what COLMAP finds is there already."""
    calls = []

    def found(source, held, out, *rest):
        calls.append(source)
        shutil.copytree(made.folder, out, dirs_exist_ok=True)
        return made

    monkeypatch.setattr(door, "make_locked", found)
    return calls


@pytest.fixture
def folder(walk, calls, tmp_path):
    """A copy of the walk."""
    return shutil.copytree(walk, tmp_path / "holiday")


def test_poses_are_made_once_and_kept_beside_the_photos(folder, calls):
    for _ in range(2):
        source = opened(folder)
        assert source.names("train") == ["holiday"]
        assert len(source.scenes("train")[0]) == PHOTOS
    assert len(calls) == 1
    assert (folder.parent / "holiday_poses/sparse/0").is_dir()
    (folder / "1.jpg").unlink()  # other photos are not mixed up
    with pytest.raises(PosesError, match="holiday_poses"):
        opened(folder)


def test_no_poses_refuses(folder, calls, monkeypatch, tmp_path):
    monkeypatch.setenv("QGS_NO_POSES", "1")
    with pytest.raises(ValueError, match="--no-poses"):
        opened(folder)
    monkeypatch.setenv("QGS_NO_POSES", "")  # and what the command sets ends with the test
    result = run_qgs("scene", folder, "--out", tmp_path / "out", "--no-poses")
    assert "--no-poses" in str(result.exception)
    assert not calls


def test_a_folder_of_something_else_is_not_written_into(folder):
    notes = folder.parent / "holiday_poses/mine.txt"
    notes.parent.mkdir()
    notes.touch()
    with pytest.raises(FileExistsError):
        opened(folder)
    assert [*notes.parent.iterdir()] == [notes]


def test_a_folder_whose_photos_are_elsewhere_is_none(tmp_path):
    (tmp_path / "a/b").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match="lists no cameras"):
        opened(tmp_path / "a")


def waiting(folder, monkeypatch):
    """A call that has seen no poses of `folder`, and waits for the lock that the caller holds."""
    came = threading.Event()

    def late(*words, **options):
        came.set()
        return locked(*words, **options)

    monkeypatch.setattr(door, "locked", late)
    call = ThreadPoolExecutor(1).submit(door.posed_folder, folder)
    assert came.wait(20)
    return call


def test_one_that_waits_takes_what_the_other_made(folder, calls, made, monkeypatch):
    out = door.beside(folder)
    with locked(folder, out, wait=False):
        call = waiting(folder, monkeypatch)
        shutil.copytree(made.folder, out, dirs_exist_ok=True)
    assert call.result(20) == out
    assert not calls


def test_one_that_waits_for_photos_without_poses_locks_a_new_folder(folder, made, monkeypatch):
    out = door.beside(folder)

    def checked(*rest):
        with pytest.raises(FileExistsError), locked(folder, out, wait=False):
            pass
        return made

    monkeypatch.setattr(door, "make_locked", checked)
    with locked(folder, out, wait=False):
        call = waiting(folder, monkeypatch)
        time.sleep(0.2)  # it waits for the lock of the folder that now is deleted
        out.rmdir()
    assert call.result(20) == out


def test_a_read_only_place_names_the_command_for_another(folder, monkeypatch):
    def refused(*rest, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(making.Path, "mkdir", refused)
    with pytest.raises(OSError, match=re.escape(f"qgs poses {folder} --out")):
        door.posed_folder(folder)

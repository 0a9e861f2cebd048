"""Photos without cameras and videos, wherever qgs takes photos."""

import json
import re
import shutil
import threading
import time
from contextlib import contextmanager

import pytest
from commands import run_qgs
from photo_formats import opened
from qgs_poses import door, making
from qgs_poses.making import locked
from qgs_poses.photos import PosesError
from walked import PHOTOS, write_video

import qgs


@pytest.fixture
def photos(walk, made, tmp_path, monkeypatch):
    """A copy of the walk; what COLMAP finds of it is there already, and asked for at most once."""
    calls = []

    def found(source, held, out, options, console):
        calls.append(source)
        shutil.copytree(made.folder, out, dirs_exist_ok=True)
        record = (out / "poses.json").read_text().replace("{", '{"again": 1,', 1)
        (out / "poses.json").write_text(record)
        return made

    monkeypatch.setattr(door, "make_locked", found)
    folder = shutil.copytree(walk, tmp_path / "holiday")
    return folder, calls


def test_poses_are_made_once_and_kept_beside_the_photos(photos):
    folder, calls = photos
    for _ in range(2):
        source = opened(folder)
        assert source.names("train") == ["holiday"]
        assert len(source.scenes("train")[0]) == PHOTOS
    assert len(calls) == 1
    assert (folder.parent / "holiday_poses" / "sparse" / "0").is_dir()


def test_no_poses_refuses_and_other_photos_are_not_mixed_up(photos, monkeypatch):
    folder, calls = photos
    with monkeypatch.context() as patch:
        patch.setenv("QGS_NO_POSES", "1")
        with pytest.raises(ValueError, match="--no-poses"):
            opened(folder)
    assert not calls
    opened(folder)
    (folder / "0.jpg").unlink()
    with pytest.raises(PosesError, match="holiday_poses"):
        opened(folder)


def test_no_poses_of_the_command_line(photos, monkeypatch, tmp_path):
    folder, calls = photos
    monkeypatch.setenv("QGS_NO_POSES", "")  # and what the command sets ends with the test
    out = str(tmp_path / "out")
    result = run_qgs("scene", str(folder), "--out", out, "--no-poses")
    assert "--no-poses" in str(result.exception)
    assert not calls


def test_the_poses_of_a_video_are_those_of_its_frames(shots, tmp_path):
    video = write_video(tmp_path / "phone.mp4", [shot.image for shot in shots])
    views = qgs.read_photos(video, size=(36, 54))
    assert views.images.shape == (1, PHOTOS, 3, 36, 54)
    assert making.read_record(tmp_path / "phone_poses") is not None


def test_a_folder_of_something_else_is_not_written_into(photos):
    folder, _ = photos
    beside = folder.parent / "holiday_poses"
    beside.mkdir()
    (beside / "mine.txt").write_text("keep")
    with pytest.raises(FileExistsError):
        opened(folder)
    assert [*beside.iterdir()] == [beside / "mine.txt"]


def test_a_folder_whose_photos_are_elsewhere_is_none(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match="lists no cameras"):
        opened(tmp_path / "a")


def waiting(folder, monkeypatch) -> tuple[threading.Thread, list]:
    """A thread that has seen no poses of `folder`, and waits for the lock that the caller holds."""
    came, results = threading.Event(), []

    @contextmanager
    def late(*words, **options):
        came.set()
        with locked(*words, **options):
            yield

    def ask() -> None:
        try:
            results.append(door.posed_folder(folder))
        except Exception as error:
            results.append(error)

    monkeypatch.setattr(door, "locked", late)
    thread = threading.Thread(target=ask)
    thread.start()
    assert came.wait(20)
    return thread, results


def test_one_that_waits_takes_what_the_other_made(photos, made, monkeypatch):
    folder, calls = photos
    out = door.beside(folder)
    with locked(folder, out, wait=False):
        thread, results = waiting(folder, monkeypatch)
        record = making.read_record(made.folder)
        shutil.copytree(made.folder, out, dirs_exist_ok=True)
        assert record
        held = {**record, "source": making.fingerprint(folder)}
        (out / "poses.json").write_text(json.dumps(held))
    thread.join(20)
    assert results == [out]
    assert not calls


def test_one_that_waits_for_photos_without_poses_locks_a_new_folder(photos, made, monkeypatch):
    folder, _ = photos
    out = door.beside(folder)

    def checked(*rest):
        with pytest.raises(FileExistsError), locked(folder, out, wait=False):
            pass
        return made

    monkeypatch.setattr(door, "make_locked", checked)
    with locked(folder, out, wait=False):
        thread, results = waiting(folder, monkeypatch)
        time.sleep(0.2)  # it waits for the lock of the folder that now is deleted
        out.rmdir()
    thread.join(20)
    assert results == [out]


def test_a_read_only_place_names_the_command_for_another(photos, monkeypatch):
    folder, _ = photos

    def refused(*rest: object, **options: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(making.Path, "mkdir", refused)
    with pytest.raises(OSError, match=re.escape(f"qgs poses {folder} --out")):
        door.posed_folder(folder)

"""Poses of a textured room, and photos without cameras wherever a command takes photos."""

import re
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
import textured_room
from photo_formats import opened
from PIL import Image
from qgs_photos.poses import door, making
from qgs_photos.poses.making import Options, make_poses
from qgs_photos.poses.photos import PosesError
from qgs_photos.poses.worker import likely
from tables import must_not_find, must_refuse, names_in, read_json
from upath import UPath
from walked import PHOTOS, QUIET, SCALE, assert_close, write_photos, write_video

import qgs
from qgs.data.photos import formats_of, read_listing


def test_photos_get_the_poses_they_were_taken_with(made, shots):
    folder, poses = made
    names = ["0 Fo’to #{} %20 'ä'.JPG", "1.jpg", "2.png", "3.tif.png", "4.avif.png", "5.png"]
    assert sorted(poses.posed) == names
    assert poses.without == ["other.png"]
    assert poses.faulty.keys() == {"broken.png", "empty.jpg"}
    assert formats_of(UPath(folder)) == ["colmap"]
    assert_close(folder, shots)
    counts, remark, *_, advice = poses.summary
    assert counts == f"{PHOTOS} of {PHOTOS + 1} photos have poses, in an arbitrary unit"
    assert "a.DNG" in remark
    assert "other.png; to get more" in advice
    assert "3.tif" in read_json(folder / "poses.json")["source"]
    assert names_in(folder) == {"images", "poses.json", "sparse"}
    # points of the model lie on the photos as they are kept, not on the copies that COLMAP saw
    size = shots[0].image.shape[:2]
    frames = read_listing(UPath(folder)).frames
    assert {Image.open(frame.path).size[::-1] for frame in frames} == {size}
    assert {frame.size for frame in frames} == {size}
    assert frames[0].intrinsics[0] == pytest.approx(145 * SCALE, rel=0.05)


def test_a_video_gets_poses_of_its_frames_where_it_is_read(shots, images, tmp_path, monkeypatch):
    # poses by several threads differ from run to run, and so do x264's B-frames
    monkeypatch.setattr(door, "Options", partial(Options, threads=1))
    video = write_video(tmp_path / "phone.mp4", images, bf="0")
    assert qgs.read_photos(video, size=(36, 54)).images.shape == (1, PHOTOS, 3, 36, 54)
    assert read_json(tmp_path / "phone_poses/poses.json")["made_by"] == "qgs poses"
    assert_close(tmp_path / "phone_poses", shots)


def test_other_folders_are_left_alone(walk, made, tmp_path):
    notes = tmp_path / "notes.txt"
    notes.write_text("keep")
    for taken in (tmp_path, notes, made[0]):
        with pytest.raises(FileExistsError):
            make_poses(walk, taken, Options(), QUIET)
    assert notes.read_text() == "keep"


def test_photos_are_matched_with_the_next_and_with_those_that_look_alike():
    """Two walks past the same 40 places, one after the other: photos n and n + 40 look alike."""
    features = np.random.default_rng(0).normal(size=(40, 20, 128)).astype(np.float32)
    features /= np.linalg.norm(features, axis=2, keepdims=True)
    features[0, 9:] = 0
    wanted = likely(np.concatenate([features, features]))
    assert np.diag(wanted, 40).all()
    assert np.diag(wanted, 1).all()
    assert (wanted == wanted.T).all()
    assert 10 <= wanted.sum(1).min() <= wanted.mean() * 80 < 30


@pytest.mark.slow
def test_one_thread_and_a_seed_give_the_same_file(walk, shots, tmp_path, monkeypatch):
    """And pairs are chosen by a quick matching."""
    monkeypatch.setattr(making, "FEW", 2)
    for name in "ab":
        make_poses(walk, tmp_path / name, Options(threads=1), QUIET)
    one, other = ((tmp_path / name / "sparse/0/images.bin").read_bytes() for name in "ab")
    assert one == other
    assert_close(tmp_path / "a", shots)


@pytest.mark.slow
def test_turning_on_the_spot_gives_no_poses(monkeypatch, shots, tmp_path):
    turns = [shot.c2w * [1, 1, 1, 0] + np.diag([0, 0, 0, 1]) for shot in shots]
    monkeypatch.setattr(textured_room, "_poses", lambda count: turns)
    folder = write_photos(tmp_path / "photos", [shot.image for shot in textured_room.walk(PHOTOS)])
    # several threads now and then find a model of points far away
    must_refuse(
        "turn on the spot",
        make_poses,
        folder,
        tmp_path / "poses",
        Options(threads=1),
        QUIET,
        kind=PosesError,
    )


@pytest.fixture
def calls(made, monkeypatch):
    """Each time that poses are made; what COLMAP finds is there already."""
    calls = []

    folder, poses = made

    def found(source, out, working, *rest):
        calls.append(source)
        time.sleep(0.2)
        shutil.copytree(folder, out, dirs_exist_ok=True)
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
    must_refuse("holiday_poses", photos_of, folder, kind=PosesError)


def test_a_training_makes_none_nor_does_a_part_of_a_model(folder, calls):
    must_not_find("Run `qgs poses`", opened, folder)
    (folder / "sparse").mkdir()
    (folder / "sparse/images.bin").touch()
    must_not_find(r"sparse .*cameras\.bin", photos_of, folder)
    assert not calls


def test_a_folder_whose_photos_are_elsewhere_is_none(tmp_path):
    (tmp_path / "a/b").mkdir(parents=True)
    must_not_find("lists no cameras", photos_of, tmp_path / "a")


def test_of_several_calls_at_once_one_makes_them_and_the_others_wait(folder, calls):
    with ThreadPoolExecutor(3) as pool:
        found = [*pool.map(door.posed_folder, [folder] * 3)]
    assert found == [door.beside(folder)] * 3
    assert len(calls) == 1


def test_a_read_only_place_names_the_command_for_another(folder, monkeypatch):
    def refused(*rest, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(door, "FileLock", refused)
    must_refuse(re.escape(f"qgs poses {folder} --out"), door.posed_folder, folder, kind=OSError)

"""Poses of a textured room against the ones that its photos were rendered with."""

import json

import numpy as np
import pytest
import textured_room
from PIL import Image
from qgs_photos.poses.making import Options, make_poses
from qgs_photos.poses.photos import PosesError
from upath import UPath
from walked import PHOTOS, SCALE, quiet, write_photos, write_video

import qgs
from qgs.data.photos import formats_of, read_listing


def relative(c2w):
    """Poses in the first one's frame, positions in parts of the farthest one's distance."""
    found = np.linalg.inv(c2w[0]) @ c2w
    found[:, :3, 3] /= np.linalg.norm(found[:, :3, 3], axis=1).max()
    return found


def assert_close(folder, shots):
    """Within a degree, .0175, and two hundredths of the extent."""
    frames = read_listing(UPath(folder)).frames
    assert len(frames) == PHOTOS
    found, true = (relative(np.stack([one.c2w for one in each])) for each in (frames, shots))
    assert np.median(np.abs(found - true).max((1, 2))) < 0.0175


def record_in(folder):
    return json.loads((folder / "poses.json").read_text())


def test_photos_get_the_poses_they_were_taken_with(made, shots, walk):
    folder, poses = made
    names = ["0 Fo’to #{} %20 'ä'.JPG", "1.jpg", "2.png", "3.tif.png", "4.webp.png", "5.png"]
    assert poses.posed == names
    assert poses.without == ["other.png"]
    assert poses.faulty.keys() == {"broken.png", "empty.jpg"}
    assert formats_of(UPath(folder)) == ["colmap"]
    assert_close(folder, shots)
    counts, remark, *_, advice = poses.summary
    assert counts == f"{PHOTOS} of {PHOTOS + 1} photos have poses"
    assert "a.HEIC" in remark
    assert "other.png; to get more" in advice
    assert "3.tif" in record_in(folder)["source"]
    assert {file.name for file in folder.iterdir()} == {"images", "poses.json", "sparse"}
    # points of the model lie on the photos as they are kept, not on the copies that COLMAP saw
    size = shots[0].image.shape[:2]
    frames = read_listing(UPath(folder)).frames
    assert {Image.open(frame.path).size[::-1] for frame in frames} == {size}
    assert {frame.size for frame in frames} == {size}
    assert frames[0].intrinsics[0] == pytest.approx(145 * SCALE, rel=0.05)


def test_a_video_gets_poses_of_its_frames_where_it_is_read(shots, images, tmp_path):
    views = qgs.read_photos(write_video(tmp_path / "phone.mp4", images), size=(36, 54))
    assert views.images.shape == (1, PHOTOS, 3, 36, 54)
    assert record_in(tmp_path / "phone_poses")["made_by"] == "qgs poses"
    assert_close(tmp_path / "phone_poses", shots)


def test_other_folders_are_left_alone(walk, made, tmp_path):
    notes = tmp_path / "notes.txt"
    notes.write_text("keep")
    for taken in (tmp_path, notes, made[0]):
        with pytest.raises(FileExistsError):
            make_poses(walk, taken, Options(), quiet())
    assert notes.read_text() == "keep"


@pytest.mark.slow
def test_one_thread_and_a_seed_give_the_same_file(walk, tmp_path):
    for name in "ab":
        make_poses(walk, tmp_path / name, Options(threads=1), quiet())
    one, other = ((tmp_path / name / "sparse/0/images.bin").read_bytes() for name in "ab")
    assert one == other


@pytest.mark.slow
def test_turning_on_the_spot_gives_no_poses(monkeypatch, shots, tmp_path):
    turns = [shot.c2w * [1, 1, 1, 0] + np.diag([0, 0, 0, 1]) for shot in shots]
    monkeypatch.setattr(textured_room, "_poses", lambda count: turns)
    folder = write_photos(tmp_path / "photos", [shot.image for shot in textured_room.walk(PHOTOS)])
    # several threads now and then find a model of points far away
    with pytest.raises(PosesError, match="turn on the spot"):
        make_poses(folder, tmp_path / "poses", Options(threads=1), quiet())

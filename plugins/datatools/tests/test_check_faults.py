"""Each planted fault is found as exactly one line; the untouched sets pass without any."""

import json
import os
from fnmatch import fnmatchcase

import numpy as np
import pytest
import torch
from PIL import Image
from planted import FLIP, told
from qgs_datatools.check import Options, check
from textured_room import SIZE
from upath import UPath

from qgs.data.photos.source import present_frames


@pytest.mark.parametrize("name", ["room", "chunks", "archives"])
def test_untouched_sets_pass(good, name):
    report = check(UPath(good / name), Options(threads=2))
    assert report.findings == []
    assert report.notes == []
    for scene in report.scenes:
        assert scene.geometry.agrees
        assert scene.geometry.pixels < 0.6
        assert scene.listed == scene.decodable > 0


ALL = "frames 0-5 (images/0.jpg to images/5.jpg): "


def resized(size):
    def change(room, shots):
        file = room.path / "images" / "3.jpg"
        Image.open(file).resize(size).save(file)

    return change


def truncated_file(room, shots):
    file = room.path / "images" / "2.jpg"
    file.write_bytes(file.read_bytes()[:-400])


def pipe(room, shots):
    (room.path / "images" / "2.jpg").unlink()
    os.mkfifo(room.path / "images" / "2.jpg")


def pose(frame, changed):
    """Replace the pose of a frame by what `changed` makes of it and of the shots."""

    def change(room, shots):
        room.poses(lambda number, c2w: changed(c2w, shots) if number == frame else c2w)

    return change


def moved(c2w, shots):
    c2w[:3, 3] = shots[2].c2w[:3, 3]
    return c2w


def listed(**values):
    return lambda room, shots: room.listing(lambda data: data.update(values))


IN_A_FOLDER = {
    "missing image": (
        lambda room, shots: (room.path / "images" / "2.jpg").unlink(),
        "images/2.jpg: *does not exist*",
    ),
    "truncated JPEG": (truncated_file, "frame 2 (images/2.jpg): *cannot be decoded*"),
    "OpenCV poses": (
        lambda room, shots: room.poses(lambda number, c2w: c2w @ FLIP),
        f"{ALL}*OpenCV poses read as OpenGL*negate columns 1 and 2*",
    ),
    "image of another shape": (
        resized((160, 120)),
        "frame 3 (images/3.jpg): *160 x 120 pixels, but listed as 180 x 120, another aspect*",
    ),
    "image of another scale than the rest": (
        resized((90, 60)),
        "frame 3 (images/3.jpg): *90 x 60 pixels, but listed as 180 x 120, another scale*",
    ),
    "width and height swapped": (
        listed(w=SIZE[0], h=SIZE[1]),
        f"{ALL}*180 x 120 pixels, but listed as 120 x 180*swapped*",
    ),
    "a listed size that intrinsics do not go with": (
        listed(w=360, h=240),
        f"{ALL}*180 x 120 pixels, but listed as 360 x 240: correct the listed*",
    ),
    "mirrored pose": (
        pose(1, lambda c2w, shots: c2w @ np.diag([-1, 1, 1, 1])),
        "frame 1 (images/1.jpg): the pose mirrors*",
    ),
    "NaN pose": (
        pose(4, lambda c2w, shots: c2w * np.nan),
        "frame 4 (images/4.jpg): the pose has NaN*",
    ),
    "a pipe": (pipe, "frame 2 (images/2.jpg): *is a pipe*"),
    "duplicate pose": (
        pose(5, lambda c2w, shots: shots[2].c2w @ FLIP),
        "frame 5 (images/5.jpg): the pose repeats that of frame 2 (images/2.jpg)*",
    ),
    "zero baseline": (pose(3, moved), "frame 3 (images/3.jpg): *frame 2 (images/2.jpg)*baseline*"),
    "principal point off the image": (
        lambda room, shots: room.listing(lambda data: data["frames"][1].update(cx=200.0)),
        "frame 1 (images/1.jpg): the principal point lies off the image*",
    ),
    "normalised intrinsics read as pixels": (
        listed(fl_x=0.8, fl_y=1.2, cx=0.5, cy=0.5),
        f"{ALL}*look normalised*",
    ),
}


@pytest.mark.parametrize("fault", IN_A_FOLDER)
def test_fault_in_a_folder(room, shots, fault):
    change, line = IN_A_FOLDER[fault]
    change(room, shots)
    (found,) = told(room.path)
    assert fnmatchcase(found, f"error: room, {line}")


def truncated(content):
    content[0]["images"][4] = content[0]["images"][4][:-400].clone()


def scaled(factors):
    def change(content):
        content[0]["cameras"][:, :4] *= torch.tensor(factors)

    return change


def opengl(content):
    content[0]["cameras"][:, 6:].reshape(-1, 3, 4)[:, 1:] *= -1


def broken_pose(content):
    content[1]["cameras"][2, 9:] = np.nan


def on_one_point(content):
    content[0]["cameras"][:, [9, 13, 17]] = 0


OF_A = "error: a, frames 0-5 (0 to 5): "
IN_A_CHUNK = {
    "NaN pose": (broken_pose, "error: b, frame 2 (2): the pose has NaN*"),
    "all cameras on one point": (on_one_point, f"{OF_A}*on one point*"),
    "truncated JPEG": (truncated, "error: a, frame 4 (4): the image cannot be decoded*"),
    "sides swapped in the intrinsics": (
        scaled([1.5, 1 / 1.5, 1.5, 1 / 1.5]),
        f"{OF_A}*width and height are swapped*",
    ),
    "OpenGL poses": (opengl, f"{OF_A}*OpenGL poses read as OpenCV*negate rows 1 and 2*"),
    "pixels": (scaled([180, 120, 180, 120]), f"{OF_A}*look like pixels*"),
}


@pytest.mark.parametrize("fault", IN_A_CHUNK)
def test_fault_in_a_chunk(chunks, fault):
    change, line = IN_A_CHUNK[fault]
    chunks.chunk(change)
    (found,) = told(chunks.path)
    assert fnmatchcase(found, line)


def far_away(number, pose):
    """In metres of a map's grid."""
    pose[:3, 3] += [2e5, 3e5, 100]
    return pose


def test_sound_poses_far_from_the_origin_pass(room):
    room.poses(far_away)
    assert told(room.path) == []


def test_zero_baseline_far_from_the_origin(room, shots):
    pose(3, moved)(room, shots)
    room.poses(far_away)
    (line,) = told(room.path)
    assert "room, frame 3 (images/3.jpg): the camera stands on the same point as that of" in line


@pytest.mark.parametrize(
    ("index", "fault"),
    [
        (
            {"nowhere": {"context": [0], "target": [1]}, "b": None},
            "nowhere: the index wanted.json *not there*",
        ),
        (
            {"b": {"context": [0, 2], "target": [3]}},
            "b, frame 3: the index wanted.json *3 frames are 0 to 2*",
        ),
    ],
)
@pytest.mark.parametrize("beside", [False, True])
def test_fault_in_an_index(chunks, tmp_path, index, fault, beside):
    """An index is checked where it is given, and where it lies with the chunks."""
    file = tmp_path / "wanted.json"
    if beside:
        fault, file = fault.replace("wanted", "evaluation"), chunks.path / "evaluation.json"
    file.write_text(json.dumps(index))
    (found,) = told(chunks.path, [] if beside else [file], geometry=0)
    assert fnmatchcase(found, f"error: {fault}")


@pytest.mark.parametrize("content", [{"key": "a"}, [torch.zeros(2), torch.zeros(2)]])
def test_chunk_that_is_no_list_of_mappings(chunks, content):
    chunks.chunk(lambda _: content)
    (found,) = told(chunks.path)
    assert fnmatchcase(found, "error: test/0.torch: *places there 2 scenes: a, b*")


def test_photos_have_one_number_in_reading_and_in_checking(room, shots):
    """Behind a photo that is missing, the number in a message is the one that `--frames` takes."""
    (room.path / "images/1.jpg").unlink()
    pose(3, lambda c2w, shots: c2w * np.nan)(room, shots)
    lines = told(room.path)
    assert any("room, images/1.jpg: the image does not exist" in line for line in lines)
    assert any("room, frame 2 (images/3.jpg): the pose has NaN" in line for line in lines)
    with pytest.raises(ValueError, match=r"frame 2 \(images/3\.jpg\): the pose has NaN"):
        present_frames(UPath(room.path))

"""Poses written in another convention than the format's are named, in every format."""

import json

import numpy as np
import photo_formats
import pytest
from planted import FLIP, photo_set
from qgs_datatools.check import Options, check
from qgs_datatools.conventions import LLFF, OPENCV, OPENCV_C2W, OPENGL
from textured_room import walk
from upath import UPath

WRITTEN_AND_READ = [
    (OPENGL, "flipped", lambda c2w: c2w),
    (OPENGL, "inverted", np.linalg.inv),
    (OPENGL, "inverted and flipped", lambda c2w: np.linalg.inv(c2w @ FLIP)),
    (OPENCV, "flipped", lambda c2w: np.linalg.inv(c2w @ FLIP)),
    (OPENCV, "inverted", lambda c2w: c2w),
    (OPENCV, "inverted and flipped", lambda c2w: c2w @ FLIP),
    (OPENCV_C2W, "flipped", lambda c2w: c2w @ FLIP),
    (OPENCV_C2W, "inverted", np.linalg.inv),
    (OPENCV_C2W, "inverted and flipped", lambda c2w: np.linalg.inv(c2w @ FLIP)),
    (LLFF, "OpenGL axes", lambda c2w: c2w @ FLIP),
    (LLFF, "OpenCV axes", lambda c2w: c2w),
    (LLFF, "flipped", lambda c2w: c2w[:, [1, 0, 2, 3]] * [-1, 1, 1, 1]),
    (LLFF, "turned", lambda c2w: c2w[:, [1, 0, 2, 3]] * [1, -1, 1, 1]),
]
"""How true OpenCV poses are written by mistake."""


def read(convention, stored: np.ndarray) -> np.ndarray:
    """What a reader of the format makes of a stored matrix."""
    if convention is OPENGL:
        return stored @ FLIP
    if convention is OPENCV:
        return np.linalg.inv(stored)
    if convention is OPENCV_C2W:
        return stored
    down, right, back, centre = stored.T
    return np.stack([right, down, -back, centre], 1)


@pytest.mark.parametrize(("convention", "name", "write"), WRITTEN_AND_READ)
def test_a_misreading_gives_the_true_poses_back(convention, name, write):
    first, second = (shot.c2w for shot in walk(2))
    meant = convention[name].meant
    as_meant = [meant(read(convention, write(pose))) for pose in (first, second)]
    relative = np.linalg.inv(as_meant[1]) @ as_meant[0]
    assert relative == pytest.approx(np.linalg.inv(second) @ first)


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> photo_formats.PhotoSet:
    """Three photos, and their poses with OpenGL's axes where OpenCV's are expected."""
    shots = walk(6)[:3]
    poses = [shot.c2w @ FLIP for shot in shots]
    return photo_set(tmp_path_factory.mktemp("photos") / "files", shots, poses)


def write_blender(folder, photos):
    return photo_formats.write_blender(folder, photo_formats.centred(photos), 3)


def write_llff(folder, photos):
    return photo_formats.write_llff(folder, photo_formats.centred(photos))


def write_colmap(folder, photos):
    return photo_formats.write_colmap(folder, photos, "binary")


def write_cameras(folder, photos):
    photo_formats.copied(photos, folder)
    listed = [
        {"image": file.name, "c2w": pose.tolist(), "K": list(photos.intrinsics)}
        for file, pose in zip(photos.files, photos.c2w, strict=True)
    ]
    (folder / "cameras.json").write_text(json.dumps(listed))
    return folder


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (write_cameras, "these look like OpenGL poses read as OpenCV"),
        (write_blender, "these look like OpenCV poses read as OpenGL"),
        (write_colmap, "these look like OpenGL poses read as OpenCV"),
        (write_llff, "the axes look like (up, right, forward), OpenGL and OpenCV mixed"),
    ],
)
def test_the_convention_is_named(photos, tmp_path, write, reason):
    path = write(tmp_path / "set", photos)
    (finding,) = check(UPath(path), Options(threads=2)).findings
    assert finding.frames == (0, 1, 2)
    assert reason in finding.reason
    assert write != write_cameras or finding.fix.endswith("of every camera-to-world matrix")

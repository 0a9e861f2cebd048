"""Poses written in another convention than the format's are named, in every format."""

import json

import numpy as np
import photo_formats
from planted import FLIP, INTRINSICS, SIZE, alike, told
from qgs_photos.datatools.conventions import LLFF, OPENCV, OPENCV_C2W, OPENGL


def test_a_misreading_gives_the_true_poses_back(shots):
    """Of what is read where the files hold true OpenCV poses, or OpenGL's, as they should not."""
    true = np.stack([shot.c2w for shot in shots[:2]])
    opengl = true @ FLIP
    w2c, opengl_w2c = np.linalg.inv([true, opengl])
    mixed = np.eye(4)[[1, 0, 2, 3]] * [1, 1, -1, 1]  # what LLFF's reader makes of other axes
    plain = {"flipped": opengl, "inverted": w2c, "inverted and flipped": opengl_w2c}
    misread = (
        (OPENCV, plain),
        (OPENCV_C2W, plain),
        (OPENGL, {name: poses @ FLIP for name, poses in plain.items()} | {"flipped": opengl}),
        (LLFF, {"flipped": opengl, "turned": true * [-1, 1, -1, 1], "inverted": w2c,
                "OpenGL axes": opengl @ mixed, "OpenCV axes": true @ mixed}),
    )  # fmt: skip
    for convention, read in misread:
        assert read.keys() == convention.keys()
        for name, poses in read.items():
            first, second = map(convention[name].meant, poses)
            turned = np.linalg.inv(second) @ first
            assert np.allclose(turned, w2c[1] @ true[0], 1e-6, 1e-12), name


def test_the_convention_is_named(good, shots, tmp_path):
    """Three photos, and their poses with OpenGL's axes where OpenCV's are expected."""
    files = tuple(good / f"room/images/{number}.jpg" for number in range(3))
    poses = np.stack([shot.c2w for shot in shots[:3]]) @ FLIP
    photos = photo_formats.PhotoSet(files, poses, INTRINSICS, SIZE)
    centred = photo_formats.centred(photos)
    photo_formats.write_blender(tmp_path / "blender", centred, 3)
    photo_formats.write_llff(tmp_path / "llff", centred)
    photo_formats.write_colmap(tmp_path / "by colmap", photos, "binary")
    listed = [
        {"image": name, "c2w": pose.tolist(), "K": INTRINSICS}
        for name, pose in zip(photo_formats.copied(photos, tmp_path / "plain"), poses, strict=True)
    ]
    (tmp_path / "plain/cameras.json").write_text(json.dumps(listed))
    expected = (
        "error: blender, frames 0-2 (*these look like OpenCV poses read as OpenGL (*",
        "error: by colmap, frames 0-2 (*these look like OpenGL poses read as OpenCV (*",
        "error: llff, frames 0-2 (*the axes look like (up, right, forward), OpenGL and OpenCV *",
        "error: plain, frames 0-2 (*these look like OpenGL poses read as OpenCV (*of every "
        "camera-to-world matrix",
    )
    found = told(tmp_path, geometry=4)

    assert alike(found, expected), found

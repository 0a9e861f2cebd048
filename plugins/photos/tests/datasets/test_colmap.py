"""COLMAP models: camera models, lenses, names, and models that are broken."""

import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from numpy.testing import assert_allclose
from photo_formats import scene as read
from photo_formats import synthetic, world_to_camera, write_colmap
from PIL import Image
from tables import assert_near, must_not_find, must_refuse, rows

from qgs.data.photos import read_listing
from qgs.paths import opened_path

SIZE = (60, 80)
KINDS = ("text", "binary")
CAMERAS = """
1 1e-4 SIMPLE_PINHOLE 60 41 29
1 1e-4 PINHOLE 60 62 41 29
1 3 SIMPLE_RADIAL 60 41 29 -0.15
1.436 8 SIMPLE_RADIAL 60 41 29 0.9
1 3 RADIAL 60 41 29 -0.12 0.05
1.033 3 OPENCV 60 62 41 29 -0.1 0.03 0.01 -0.02
1 3 OPENCV_FISHEYE 50 52 41 29 0.05 -0.02 0.01 -0.003
1 3 SIMPLE_RADIAL_FISHEYE 50 41 29 0.05
1 3 RADIAL_FISHEYE 50 41 29 0.05 -0.02
1 3 FULL_OPENCV 60 62 41 29 -0.1 0.03 0.01 -0.02 0.01 0.02 0.01 0.01
1.036 3 FOV 60 62 41 29 0.4
1 3 THIN_PRISM_FISHEYE 60 62 41 29 0.05 -0.02 0.01 -0.003 0.01 0.01 0.01 -0.01
"""
"""How much larger photos become, without black edges, and the largest error of a level, where
resampling reads beyond an edge; names and parameters."""


@pytest.fixture
def photos(tmp_path):
    return synthetic(tmp_path / "photos", 3)


def frames(folder):
    return read_listing(opened_path(folder)).frames


def colours(directions):
    """What a far wall shows in directions (..., 2) of the plane z = 1, as 8-bit RGB."""
    x, y = np.moveaxis(directions, -1, 0)
    levels = 128 + 80 * np.stack([np.sin(2 * x), np.cos(3 * y), np.sin(2 * x - y)], -1)
    return levels.round().clip(1, 255).astype(np.uint8)


def pixel_centres(size=SIZE):
    v, u = np.mgrid[: size[0], : size[1]] + 0.5
    return np.stack([u, v], -1)


@pytest.mark.parametrize("camera", CAMERAS.split("\n")[1:-1])
def test_photos_of_every_camera_become_pinhole_photos(tmp_path, camera):
    """pycolmap says in which direction each pixel of the lens looks; text and binary read alike."""
    known, most, name, *numbers = camera.split()
    parameters = [*map(float, numbers)]
    lens = pycolmap.Camera(model=name, width=SIZE[1], height=SIZE[0], params=parameters)
    directions = lens.cam_from_img(pixel_centres().reshape(-1, 2)).reshape(*SIZE, 2)
    photos = synthetic(tmp_path / "photos", 2, SIZE)
    for file in photos.files:
        Image.fromarray(colours(directions)).save(file)
    folders = [write_colmap(tmp_path / kind, photos, kind, (name, parameters)) for kind in KINDS]
    (of_text, _), (of_binary, _) = map(frames, folders)
    assert of_text.intrinsics == of_binary.intrinsics
    assert of_text.lens == of_binary.lens
    for size in ((60, 60), SIZE):
        scene = read(folders[1], size)
        fx, fy, cx, cy = scene.cameras.intrinsics[0].tolist()
        pixels = scene.images([1])[0].mul(255).permute(1, 2, 0).numpy()
        error = np.abs(pixels - colours((pixel_centres(size) - [cx, cy]) / [fx, fy]))
        assert error.max() < float(most)
        assert error.mean() < 0.5
    zoom = fx / lens.focal_length_x  # where undistortion would leave black edges
    assert_near(zoom, float(known), rtol=0.01)
    assert_near(fy, zoom * lens.focal_length_y)
    middle = np.array(SIZE[::-1]) / 2
    assert_allclose([cx, cy], middle + zoom * ([41, 29] - middle))

    if "PINHOLE" in name:
        return
    points = torch.tensor([[0.0, 0.0], [0.3, -0.2], [-0.5, 0.4], [0.01, 0.6]]).double()
    expected = lens.img_from_cam(np.column_stack([points, np.ones(4)]))
    bent = of_text.lens.distorted(points).numpy()
    focal = lens.focal_length_x, lens.focal_length_y
    assert_allclose(bent * focal + [41, 29], expected, atol=1e-9)


def test_names_in_folders_are_read_in_their_order(tmp_path, photos):
    """Blanks in names too, which pycolmap cannot read."""
    for kind, last in (("text", "right/1 a.png"), ("binary", "right/1.png")):
        names = [last, "left/2.png", "left/10.png"]
        ordered = [f"images/{name}" for name in reversed(names)]
        scene = read(write_colmap(tmp_path / kind, photos, kind, names=names))
        assert [scene.frame_name(i) for i in range(3)] == ordered
        assert_allclose(scene.cameras.c2w, photos.c2w[[2, 1, 0]], atol=1e-9)


def test_quaternions_are_normalised(tmp_path, photos):
    folder = write_colmap(tmp_path, photos, "text")
    longer = np.multiply(world_to_camera(photos.c2w[0]), [1.5] * 4 + [1] * 3)
    line = f"1 {' '.join(map(str, longer))} 7 view_000.png\n\n"
    (folder / "sparse/0/images.txt").write_text(line)
    assert_allclose(frames(folder)[0].c2w, photos.c2w[0], atol=1e-9)


CUT = {"images.bin": (4, 60, 110, 200, -1), "cameras.bin": (40,)}
"""How much of a file is left: no count, a part of a pose, of points, of an image, of a camera."""
COUNTS = {"images.bin": b"\1", "cameras.bin": b"\0"}
"""Fewer than there are."""
UNKNOWN_CAMERA = struct.pack("<QIiQQ3d", 1, 7, 99, 40, 30, 1, 1, 1)
BROKEN = """
cameras.txt | 7 PINHOLE 4_0 30 50 52 19 16/
cameras.txt | 7 PINHOLE 40 30 50 52 19 16/7 PINHOLE 40 30 50 52 19 16/
cameras.txt | 7 FISHEYE624 40 30 1/
images.txt | 1 1 0 0 0 0 0 1 a.png//
images.txt | 1 1 0 0 0 0 0 1 7 a.png//1 1 0 0 0 0 0 1 7 a.png//
images.txt | # Number of images: 3/1 1 0 0 0 0 0 1 7 view_000.png//2 1 0 0 0 0 0 1 7 view_001.png//
images.txt | 1 1 0 0 0 0 0 1 7 view_000.png/1 2 3/2 1 0 0 0 0 0 1 7 view_001.png/1 2 3/3 1 0/
images.txt | 1 1 0 0 0 0 0 1 7 view_000.png//2 1 0 0 0 0 0 1 7 view_001.png//3 .6 .8/
images.txt | 1 1 0 0 0 zero 0 1 7 a.png//
images.txt | 1 0 0 0 0 0 0 1 7 a.png//
images.txt | 1 1 0 0 0 1_000 0 1 7 a.png//
images.txt | 1 1 0 0 0 0 0 1 8 a.png//
"""
"""Lines of a file, each ended by a slash.

Digits of Python, a camera twice, an unknown model; a number too few, an image twice, an image
less than the header says, two that are cut off where a line of points or none comes before; no
number, a quaternion of length 0, digits of Python, no such camera.
"""


def test_broken_models_are_told(tmp_path, photos):
    folders = {kind: write_colmap(tmp_path / kind, photos, kind) for kind in KINDS}
    whole = folders["binary"] / "sparse/0"
    broken = [("cameras.bin", UNKNOWN_CAMERA)]
    broken += [(name, lines.replace("/", "\n").encode()) for name, lines in rows(BROKEN)]
    broken += [(n, (whole / n).read_bytes()[:kept]) for n, parts in CUT.items() for kept in parts]
    broken += [(n, count + (whole / n).read_bytes()[1:]) for n, count in COUNTS.items()]
    for name, content in broken:
        folder = folders["text" if name.endswith("txt") else "binary"]
        file = folder / "sparse/0" / name
        sound = file.read_bytes()
        file.write_bytes(content)
        must_refuse("sparse/0", read, folder)
        file.write_bytes(sound)


def test_photos_beside_the_model_are_needed(tmp_path, photos):
    folder = write_colmap(tmp_path, photos, "text", images="pictures")
    must_not_find("`images`", read, folder)
    assert read(folder, images="pictures").frame_name(1) == "pictures/view_001.png"


LEFT = (
    ("lists no 2D points: all 3 lines", r"\n[38]\..*", ""),
    ("no camera 8", "7 view_001", "8 view_001"),
    ("frame 1 .*NaN", r"\n2 \S+", "\n2 -nan(ind)"),
)
"""What is told of images.txt where programs leave something else in place of a pattern."""


def test_images_as_programs_leave_them(tmp_path, photos, caplog):
    names = ["a b c.png", "view_001.png", "z (1) 2 3.png"]
    for told, pattern, left in LEFT:
        folder = write_colmap(tmp_path / told[-9:], photos, "text", names=names)
        file = folder / "sparse/0/images.txt"
        file.write_text(re.sub(pattern, left, file.read_text()))
        assert len(read(folder)) == (3 if "points" in told else 2)
        assert re.search(told, caplog.text)


MODELS = """
sparse/0 | sparse/0 | images
dense/0/sparse | dense/0/sparse | dense/0/images
colmap/sparse/0 | colmap/sparse | images
colmap/sparse/0 | . | images
sparse | . | images
. | . | .
dense/0/sparse | . | dense/0/images
Sparse/0 | . | images
sparse/1 | . | images
"""
"""Where a model lies, which folder is given, and where the photos lie that are read."""


def test_which_model_is_read(tmp_path, photos, caplog):
    """With its own photos, the largest, and its project's where its own folder is given."""
    few = replace(photos, files=photos.files[:2])
    for model, given, images in rows(MODELS):
        folder = tmp_path / f"{model} {given}".replace("/", "")
        write_colmap(folder, photos, "text", model=model, images=images)
        if model == "sparse/1":
            write_colmap(folder, few, "text")
        read_frames = read(folder / given).photos
        paths = [Path(frame.path) for frame in read_frames]
        assert paths == [folder / images / file.name for file in photos.files]
    assert re.search(
        r"2 COLMAP models exist: .*1 with 3 photos is read, and not .*0 \(2\)", caplog.text
    )

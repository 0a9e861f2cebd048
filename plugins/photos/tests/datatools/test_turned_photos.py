"""Photos whose EXIF turns them: their cameras turn with them."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from photo_formats import encoded, scene, turned
from PIL import Image
from planted import Room, checked
from qgs_photos.datatools.entries import Encoding, encoded_frames
from qgs_photos.datatools.geometry import Geometry, geometry_findings
from qgs_photos.datatools.photos import Decoded, DecodedScene
from textured_room import INTRINSICS, SIZE
from upath import UPath

from qgs.data.photos.reader import PhotoFrame
from qgs.data.photos.source import upright

FX, FY, CX, CY = INTRINSICS
HEIGHT, WIDTH = SIZE
SIDES = {"fl_x": FY, "fl_y": FX, "w": HEIGHT, "h": WIDTH}
STORED = {
    6: (1, Image.Transpose.ROTATE_90, {**SIDES, "cx": CY, "cy": WIDTH - CX}),
    8: (3, Image.Transpose.ROTATE_270, {**SIDES, "cx": HEIGHT - CY, "cy": CX}),
    3: (2, Image.Transpose.ROTATE_180, {"cx": WIDTH - CX, "cy": HEIGHT - CY}),
}
"""By EXIF's orientation: the quarter turns of a picture clockwise, how an upright one is
stored, and the camera of the stored pixels."""


@pytest.fixture
def written(shots, tmp_path):
    """Writes stored photos. listed: of which pixels the cameras are, "stored" or "upright"."""

    def written(orientation, listed, **lens):
        room = Room(shots[:4])
        turns, transpose, camera = STORED[orientation]
        if listed == "stored":
            room.camera |= camera
            room.poses[:, :, :2] @= np.linalg.matrix_power([[0, -1], [1, 0]], turns)
        room.camera |= lens
        masks = []
        for name, shot in zip(list(room.files), shots, strict=False):
            image = Image.fromarray(shot.image).transpose(transpose)
            room.files[name] = encoded(image, exif=turned(orientation))
            masks.append(255 * (np.array(image)[..., 0] > 128).astype(np.uint8))
        room.mask(masks)
        return room.write(tmp_path / f"{orientation} {listed}")

    return written


def test_cameras_and_pixels_are_the_upright_ones(written, shots):
    """Nothing tells a half turn: its cameras are those of the stored pixels."""
    for case in ((6, "stored"), (8, "stored"), (3, "stored"), (6, "upright"), (8, "upright")):
        folder = written(*case)
        read = scene(folder, SIZE)
        assert_allclose(read.cameras.c2w, [s.c2w for s in shots[:4]], 1e-7, 1e-7)
        assert_allclose(read.cameras.intrinsics, [INTRINSICS] * 4, 1e-7)
        assert_allclose(read.images([1])[0].permute(1, 2, 0) * 255, shots[1].image, 1e-6)
        assert_allclose(read.masks([1])[0, 0], shots[1].image[..., 0] > 128)
        assert read.stored_size(0) == SIZE
        report = checked(folder)
        assert not report.findings
        assert float(report.scenes[0].epipolar) < 1


def test_a_lens_turns_with_its_photo(written, shots):
    """The tangential part (p2, p1) is a vector in the image: x to y, y to -x."""
    stored = scene(written(6, "stored", k1=0.05, p1=0.004, p2=-0.003), SIZE)
    folder = written(6, "upright", k1=0.05, p1=-0.003, p2=-0.004)
    (folder / "images/0.jpg").write_bytes(encoded(shots[0].image))
    found, expected = (read.images([0]) for read in (stored, scene(folder, SIZE)))
    assert torch.allclose(found, expected, 0, 1.5 / 255)


def test_packed_photos_are_upright(written, shots, tmp_path):
    frame, *_ = encoded_frames(scene(written(8, "stored"), SIZE), Encoding())
    assert_array_equal(frame.mask, 255 * (shots[0].image[..., 0] > 128))
    assert frame.listed.size == SIZE
    assert_allclose(frame.listed.c2w, shots[0].c2w, atol=1e-12)
    path = tmp_path / "packed.png"
    path.write_bytes(frame.data)
    image = Image.open(path)
    assert_array_equal(image, shots[0].image)
    assert frame.kept == (not image.getexif().get(0x0112))


def test_of_squares_a_warning_says_whose_cameras_they_have(tmp_path, caplog):
    path = UPath(tmp_path / "square.png")
    path.write_bytes(encoded(np.zeros((4, 4, 3), np.uint8), exif=turned(6)))
    frame = upright(PhotoFrame("square.png", path, np.eye(4), INTRINSICS))
    assert frame.turns == 1
    assert "poses must belong to the stored pixels" in caplog.text
    photos = [SimpleNamespace(listed=frame, exists=True)] * 2
    squares = DecodedScene("squares", photos, [Decoded(size=(4, 4))] * 2)
    (finding,) = geometry_findings(squares, Geometry(pairs={(0, 1): 0.1}))
    assert "turned by EXIF" in finding.fix

"""Lenses of nerfstudio's listings, and photos without their distortion."""

import math

import numpy as np
from photo_formats import numbered_photos, scene
from qgs_photos.datasets.lenses import bending

from qgs.data.photos.nerfstudio import read_transforms
from qgs.paths import opened_path


def test_lenses_of_nerfstudio(tmp_path):
    fisheye = {"camera_model": "OPENCV_FISHEYE", "k3": 0.0, "k4": 0.3}
    cameras = ({}, fisheye, {"k1": 0, "p2": 0, "k3": None})
    numbered_photos(tmp_path, 3, cameras=cameras, k1=0.1, p2=0.01, k3=0.002)
    frames = read_transforms(opened_path(tmp_path) / "transforms.json")
    lenses = [frame.lens for frame in frames]
    plain = bending("FULL_OPENCV", {"k1": 0.1, "p2": 0.01, "k3": 0.002})
    assert lenses == [plain, bending("OPENCV_FISHEYE", {"k1": 0.1, "k4": 0.3}), None]


def test_where_the_lens_would_fold_the_photo_it_sees_nothing(tmp_path):
    """x (1 - 0.6 x^2) is largest at 0.745, and x of its angle's polynomial at an angle of it."""
    largest = math.sqrt(1 / 1.8)
    wide = {"fl_x": 30.0, "fl_y": 30.0, "cx": 32.0, "cy": 24.0}
    for model, turn in (("OPENCV", largest), ("OPENCV_FISHEYE", math.tan(largest))):
        lens = bending(model, {"k1": -0.6})
        image = lens.undistorted(np.ones((48, 64), np.uint8), (*wide.values(),))
        reach = math.ceil(30 * turn - 0.5)
        assert not image[24, 32 + reach :].any()
        assert image[24, 32 : 32 + reach].all()
        path = numbered_photos(tmp_path, 3, camera_model=model, k1=-0.6, **wide)
        assert (scene(path, size=(48, 64)).images([2])[0, 2] > 0).all()

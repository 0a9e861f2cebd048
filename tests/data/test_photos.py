import json
import math
from functools import partial

import numpy as np
import photo_formats
import pytest
import torch
from photo_formats import row_of_frames
from PIL import Image
from tables import fault

from qgs.data.images import CropResize
from qgs.data.lenses import Fisheye, RadialTangential, undistorted

GLOBAL = {"fl_x": 100.0, "fl_y": 110.0, "cx": 31.0, "cy": 25.0, "w": 64, "h": 48}


def folder(path, count=10, size=(64, 48), frame=None, **top):
    """Photos whose red channel is the frame's number; `frame` changes entries of frame 1."""
    (path / "images").mkdir(exist_ok=True)
    for i in range(count):
        Image.new("RGB", size, (10 * i, 50, 200)).save(path / "images" / f"{i}.png")
    content = row_of_frames(count, **GLOBAL | top)
    content["frames"][1].update(frame or {})
    (path / "transforms.json").write_text(json.dumps(content))
    return path


opened = partial(photo_formats.opened, size=(24, 24))


def test_poses_become_opencv_and_intrinsics_follow(tmp_path):
    scene = opened(folder(tmp_path)).scenes("train")[0]
    expected = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    expected[0, 3] = 3
    assert torch.equal(scene.cameras.c2w[3], expected)
    assert scene.cameras.intrinsics[0].tolist() == pytest.approx([50, 55, 11.5, 12.5])
    assert scene.images([7])[0, :, 5, 5].mul(255).round().tolist() == [70, 50, 200]


def test_intrinsics_of_one_frame_and_of_a_smaller_copy(tmp_path):
    path = folder(tmp_path, size=(32, 24), frame={"fl_x": 200.0})
    cameras = opened(path, image_size=(24, 32)).scenes("test")[0].cameras
    assert cameras.intrinsics[0].tolist() == pytest.approx([50, 55, 15.5, 12.5])
    assert cameras.intrinsics[1, 0] == pytest.approx(100)


def test_crop_then_resize():
    crop = CropResize((100, 300), (50, 50))
    assert crop.box == (100, 0, 200, 100)
    assert crop.intrinsics(torch.tensor([90.0, 80, 150, 50])).tolist() == [45, 40, 25, 25]


def test_held_out_frames(tmp_path):
    assert opened(folder(tmp_path)).scenes("test")[0].held_out == (4,)
    assert opened(tmp_path, holdout=3).scenes("test")[0].held_out == (1, 4, 7)
    assert opened(tmp_path, holdout=0).scenes("test")[0].held_out == ()


def test_missing_images_are_counted_and_named(tmp_path, caplog):
    folder(tmp_path)
    (tmp_path / "images" / "3.png").unlink()
    source = opened(tmp_path)
    assert source.scenes("train")[0].missing == [str(tmp_path / "images" / "3.png")]
    assert "1 of 10" in caplog.text
    assert "3.png" in caplog.text
    assert len(source.scenes("train")[0]) == 9
    for i in set(range(10)) - {3, 5}:
        (tmp_path / "images" / f"{i}.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"\b10\b.*\b1\b"):
        opened(tmp_path)


REFUSED = [
    ({"transform_matrix": [[math.nan] * 4] * 4}, {}, r"frame 1 \(images/1.png\).*NaN"),
    ({"transform_matrix": np.diag([2, 1, 1, 1]).tolist()}, {}, "frame 1 .*rigid"),
    ({"transform_matrix": np.diag([-1, 1, 1, 1]).tolist()}, {}, "frame 1 .*rigid"),
    ({"transform_matrix": [1, 2]}, {}, "frame 1 .*4 x 4"),
    ({"file_path": None}, {}, "frame 1.*'file_path'"),
    ({}, {"fl_x": None}, "focal"),
    ({}, {"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
    ({}, {"camera_model": "OPENCV_FISHEYE", "k5": 0.1}, "k5"),
    ({}, {"fl_x": 1.2, "fl_y": 1.3, "cx": 0.5, "cy": 0.5}, "frame 0 .*pixels"),
    ({}, {"w": 48, "h": 64}, "swapped"),
    ({"k6": 1e-3}, {}, "frame 1 .*k6"),
    ({}, {"s1": 1e-3}, "s1"),
    ({}, {"k1": math.nan}, "k1"),
    ({}, {"w": 48}, "aspect"),
]


def test_what_cannot_be_meant_is_refused(tmp_path):
    faults = [
        fault(word, opened, folder(tmp_path, frame=frame, **top)) for frame, top, word in REFUSED
    ]
    assert not any(faults), faults


def test_folders_and_files_that_are_not_there(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        opened(tmp_path / "nothing")
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    monkeypatch.setenv("QGS_NO_POSES", "1")
    with pytest.raises(ValueError, match="no camera poses"):
        opened(tmp_path)
    (tmp_path / "transforms.json").write_text("{")
    with pytest.raises(ValueError, match="not valid JSON"):
        opened(tmp_path)


def test_files_outside_of_the_folder_are_read_only_if_allowed(tmp_path):
    for name in ("mine", "other"):
        (tmp_path / name).mkdir()
    folder(tmp_path / "other")
    mine = tmp_path / "mine"
    (mine / "linked").symlink_to(tmp_path / "other")  # a link in the folder is the user's own
    for of in ("depth_file_path", "mask_path", "file_path"):
        assert opened(folder(mine, frame={of: "linked/images/1.png"})).scenes("train")
        for place in ("../other/images/1.png", f"{tmp_path}/other/images/1.png"):
            folder(mine, frame={of: place})
            assert not fault(r"other/images/1\.png", opened, mine), of
            assert of != "file_path" or opened(mine, outside=True).scenes("train")


def test_transparent_pixels_show_the_background(tmp_path):
    folder(tmp_path)
    Image.new("RGBA", (64, 48), (0, 0, 0, 0)).save(tmp_path / "images" / "0.png")
    scene = opened(tmp_path, background=(1.0, 0.0, 0.0)).scenes("train")[0]
    assert scene.images([0])[0, :, 3, 3].tolist() == [1, 0, 0]


def test_lens_distortion_is_undone(tmp_path):
    distorted = folder(tmp_path, k1=-0.5, cx=32.0, cy=24.0)
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[:, :, 0] = np.arange(64) * 4
    Image.fromarray(pixels).save(tmp_path / "images" / "0.png")
    image = opened(distorted, image_size=(48, 64)).scenes("train")[0].images([0])[0, 0] * 255
    x = (60.5 - 32) / 100
    y = 0.5 / 110
    expected = 32 + 100 * x * (1 - 0.5 * (x * x + y * y)) - 0.5
    assert image[24, 60].item() == pytest.approx(4 * expected, abs=2)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_where_the_lens_would_fold_the_photo_it_sees_nothing(tmp_path, model):
    """x (1 - 0.6 x^2) is largest at 0.745, and x of its angle's polynomial at an angle of it."""
    turn = math.sqrt(1 / 1.8) if model == "OPENCV" else math.tan(math.sqrt(1 / 1.8))
    wide = {"fl_x": 30.0, "fl_y": 30.0, "cx": 32.0, "cy": 24.0}
    path = folder(tmp_path, camera_model=model, k1=-0.6, **wide)
    lens = (RadialTangential if model == "OPENCV" else Fisheye)(k1=-0.6)
    image = undistorted(np.ones((48, 64), np.uint8), (30.0, 30.0, 32.0, 24.0), lens)
    reach = math.ceil(30 * turn - 0.5)
    assert not image[24, 32 + reach :].any()
    assert image[24, 32 : 32 + reach].all()
    assert (opened(path, image_size=(48, 64)).scenes("train")[0].images([2])[0, 2] > 0).all()


@pytest.mark.parametrize("size", [(48, 64), (24, 24)])
def test_black_edges_of_undistorted_photos_are_cut_off(tmp_path, size):
    distorted = folder(tmp_path, k1=0.9, cx=36.0, cy=24.0)
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[:, :, 0], pixels[:, :, 1] = np.arange(64) * 3 + 9, 255
    Image.fromarray(pixels).save(tmp_path / "images" / "0.png")
    scene = opened(distorted, image_size=size).scenes("train")[0]
    image, (fx, fy, cx, cy) = scene.images([0])[0] * 255, scene.cameras.intrinsics[0].tolist()
    assert (image[1] > 240).all()  # resampling overshoots a little
    row, column = size[0] // 2, size[1] - 4  # a pixel still shows what its camera says
    x, y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
    expected = 36 + 100 * x * (1 + 0.9 * (x * x + y * y)) - 0.5
    assert image[0, row, column].item() == pytest.approx(3 * expected + 9, abs=3)


def test_each_coefficient_bends_rays_as_opencv_writes_it():
    for coefficients in (0.15 * np.eye(5)).tolist():
        k1, k2, p1, p2, k3 = coefficients
        for x, y in ((0.3, -0.4), (-0.7, 0.2), (0.0, 0.5)):
            r = math.hypot(x, y)
            radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
            expected = (
                x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
                y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
            )
            bent = RadialTangential(*coefficients).distorted(torch.tensor([x, y]).double())
            assert bent.tolist() == pytest.approx(expected)

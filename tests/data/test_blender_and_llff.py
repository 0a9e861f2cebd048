"""Blender's splits and alpha; LLFF's rows and what goes wrong with them."""

import numpy as np
import pytest
import torch
from photo_formats import centred, synthetic, write_blender, write_llff
from photo_formats import scene as read
from PIL import Image
from tables import assert_near, must_refuse


@pytest.fixture
def photos(tmp_path):
    return centred(synthetic(tmp_path / "photos"))


def test_splits_come_from_the_files(tmp_path, photos):
    scene = read(write_blender(tmp_path, photos, train=3, val=1), holdout=2)
    assert scene.held_out == (3, 4, 5)
    for i, part in enumerate(["train", "train", "train", "val", "test", "test"]):
        assert scene.frame_name(i) == f"{part}/view_{i:03d}.png"


def test_alpha_is_the_mask_and_shows_the_background(tmp_path, photos):
    write_blender(tmp_path, photos, train=6)
    alpha = np.zeros((30, 40, 4), np.uint8)
    alpha[:, :20] = [10, 20, 30, 255]
    alpha[:, 20:] = [90, 90, 90, 102]
    Image.fromarray(alpha).save(tmp_path / "train/view_001.png")
    scene = read(tmp_path, background=(0.0, 1.0, 0.0))
    masks = scene.masks([1, 2])
    assert_near(masks[0, 0, 5, [3, 35]], [1, 0.4])
    assert torch.equal(masks[1], torch.ones(1, 30, 40)), "a photo without alpha has nothing to hide"
    shown = scene.images([1])[0, :, 5].mul(255).round()
    assert shown[:, 3].tolist() == [10, 20, 30]
    assert shown[:, 35].tolist() == [36, 189, 36]


def test_the_angle_of_view_goes_with_the_images_which_cannot_be_replaced(tmp_path, photos):
    write_blender(tmp_path, photos, train=6)
    for file in (tmp_path / "train").iterdir():
        Image.open(file).resize((80, 60)).save(file)
    assert_near(read(tmp_path, (60, 80)).cameras.intrinsics[0], [100, 100, 40, 30])
    must_refuse("`images`", read, tmp_path, images="images_2")


def test_the_published_axes(tmp_path):
    """A camera at (1, 2, 3) that looks along world +x with world +z up: down is -z, right is -y."""
    row = np.zeros((2, 17))
    row[:, :15] = np.ravel([[0, 0, -1, 1, 30], [0, -1, 0, 2, 40], [-1, 0, 0, 3, 50]])
    np.save(tmp_path / "poses_bounds.npy", row)
    (tmp_path / "images").mkdir()
    for name in ("b.JPG", "a.JPG"):
        Image.new("RGB", (40, 30)).save(tmp_path / "images" / name)
    scene = read(tmp_path)
    assert [scene.frame_name(i) for i in range(2)] == ["images/a.JPG", "images/b.JPG"]
    assert scene.cameras.c2w[0, :3].T.tolist() == [[0, -1, 0], [0, 0, -1], [1, 0, 0], [1, 2, 3]]
    assert scene.cameras.intrinsics[0].tolist() == [50, 50, 20, 15]


def test_files_that_are_no_rows_are_told(tmp_path, photos):
    file = write_llff(tmp_path, photos) / "poses_bounds.npy"
    objects = [[None] * 17]
    narrow = [[1.0] * 16 + [0.5]] * 6
    for content in (np.zeros((3, 15)), objects, narrow, b"hello"):
        file.write_bytes(content) if isinstance(content, bytes) else np.save(file, content)
        must_refuse(r"poses_bounds\.npy", read, tmp_path)


def test_a_row_of_nan_costs_its_photo(tmp_path, photos, caplog):
    write_llff(tmp_path, photos)
    rows = np.load(tmp_path / "poses_bounds.npy")
    rows[2, 3] = np.nan
    np.save(tmp_path / "poses_bounds.npy", rows)
    assert len(read(tmp_path)) == len(photos.files) - 1
    assert "left out: frame 2 (images/view_002.png): the pose has NaN" in caplog.text

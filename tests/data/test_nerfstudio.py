"""nerfstudio's masks, depth maps, splits and scaled copies."""

import re
from functools import partial
from pathlib import Path

import numpy as np
import photo_formats
import pytest
import torch
from photo_formats import synthetic, write_nerfstudio
from PIL import Image
from tables import assert_equal, assert_near, must_not_find, must_refuse, read_json, write_json


@pytest.fixture(autouse=True)
def _in_a_folder_of_photos(here):
    write_nerfstudio(here, synthetic(here / "photos"))


LISTING = Path("transforms.json")
read = partial(photo_formats.scene, ".")


def change(frame=None, **values):
    content = read_json(LISTING)
    (content if frame is None else content["frames"][frame]).update(values)
    write_json(LISTING, content)


def test_masks_are_read_at_the_delivered_size():
    change(1, mask_path="left.png")
    must_not_find(r"left\.png", read)
    mask = np.zeros((30, 40), np.uint8)
    mask[:, :20] = 255
    Image.fromarray(mask).save("left.png")
    masks = read((15, 20)).masks([1, 2])
    assert masks[0, 0, 7, [2, 17]].tolist() == [1, 0]
    assert_equal(masks[1], torch.ones(1, 15, 20))


def test_depth_maps():
    depth = (1000 + 10 * np.arange(30 * 40).reshape(30, 40)).astype(np.uint16)
    Image.fromarray(depth).save("depth.png")
    change(1, depth_file_path="depth.png")
    scene = read()
    unknown, known = scene.depths([0, 1])
    assert not unknown.any()
    assert known.any()
    assert scene.depths([0]) is None
    halved = read((15, 20), depth_unit=2.0).depths([1])
    assert halved.shape == (1, 1, 15, 20)
    assert {*halved.flatten().tolist()} <= {*(2.0 * depth).ravel().tolist()}


def test_depth_that_is_not_finite_is_unknown():
    depth = np.full((30, 40, 1), 2000.0)
    depth[3, 4] = np.nan
    depth[5, 6] = np.inf
    np.save("depth.npy", depth)
    change(0, depth_file_path="depth.npy")
    assert read().depths([0])[0, 0, [3, 5, 7], [4, 6, 8]].tolist() == [0, 0, 2]
    np.save("depth.npy", np.zeros((30, 40, 3)))
    must_refuse("one channel", read().depths, [0])


NAMES = [f"images/view_{i:03d}.png" for i in range(6)]


def test_splits(caplog):
    whole = LISTING.read_text()
    for splits, count, held_out in (
        ({"train_filenames": NAMES[:4]}, 6, (4, 5)),
        ({"test_filenames": [rf"D:\a\{NAMES[2]}"]}, 6, (2,)),
        ({"train_filenames": NAMES[:3], "val_filenames": NAMES[2:]}, 6, (2, 3, 4, 5)),
        ({"train_filenames": NAMES[:3], "test_filenames": NAMES[4:]}, 5, (3, 4)),
    ):
        LISTING.write_text(whole)
        change(**splits)
        scene = read(holdout=2)
        assert len(scene) == count
        assert scene.held_out == held_out
        assert ("in none of its splits" in caplog.text) == (count == 5)


def test_a_split_that_names_no_frame_is_told():
    change(train_filenames=["images/other.png"])
    must_refuse(r"transforms\.json: 'train_filenames' names .*other\.png", read)


def test_an_angle_of_view_without_a_size_goes_with_the_first_image():
    change(fl_x=None, fl_y=None, cx=None, cy=None, w=None, h=None)
    change(camera_angle_x=np.pi / 2)
    assert_near(read().cameras.intrinsics[3], [20, 20, 20, 15])


def test_doubtful_intrinsics_are_read_and_told(caplog):
    change(2, cx=55.0)
    change(4, fl_x=2000.0, fl_y=2000.0)
    change(5, file_path=None)
    assert read().cameras.intrinsics[[2, 4], [2, 0]].tolist() == [55, 2000]
    told = r"frame 5: its 'file_path'[\s\S]*2 of 6 frames .*implausible.*: images/view_002\.png"
    assert re.search(told, caplog.text)


def test_the_world_is_that_of_the_poses():
    before = read().cameras.c2w
    change(applied_transform=[[0, 1, 0, 5], [1, 0, 0, 0], [0, 0, -1, 0]], applied_scale=3)
    assert_equal(read().cameras.c2w, before)


def test_images_of_another_size_are_told_when_decoded():
    Image.new("RGB", (40, 40)).save(NAMES[3])
    must_refuse(r"view_003\.png", read().images, [3])


def test_a_matrix_of_intrinsics_and_numbers_as_text_are_read():
    expected = read().cameras
    change(w="40", h="30", fl_x="50.0", fl_y=None, cx=None, cy=None)
    for frame, key in enumerate(("K", "intrinsic_matrix")):
        change(frame, **{key: [["50", 0, 19], [0, 52, 16], [0, 0, 1]]})
    changed = read().cameras
    assert_equal(changed.intrinsics[:2], expected.intrinsics[:2])
    assert changed.intrinsics[2].tolist() == [50, 50, 20, 15]
    change(2, transform_matrix=None)
    assert len(read()) == 5


def test_a_scale_of_rotations_is_divided_out_and_a_stray_camera_left_out(caplog):
    expected = read().cameras.c2w
    scaled = read_json(LISTING)["frames"]
    for number, frame in enumerate(scaled):
        pose = np.array(frame["transform_matrix"])
        pose[:3, :3] *= 2.5
        pose[0, 3] += 4500 * (number == 3)
        change(number, transform_matrix=pose.tolist())
    assert torch.allclose(read().cameras.c2w, expected[[0, 1, 2, 4, 5]])
    assert "rotations of 6 frames" in caplog.text
    assert "frame 3 (images/view_003.png): the camera stands" in caplog.text
    pose[:3, 0] *= 1.1
    change(5, transform_matrix=pose.tolist())
    assert len(read()) == 4

import json
import re
from functools import partial

import photo_formats
from photo_formats import numbered_photos
from PIL import Image
from tables import assert_near, must_not_find, must_refuse, rows


def folder(path, frame=None, **options):
    """Photos of which frame 1 has entries of its own."""
    return numbered_photos(path, cameras=({}, frame or {}), **options)


opened = partial(photo_formats.opened, size=(24, 24))
read = partial(photo_formats.scene, size=(24, 24))


def test_intrinsics_follow_the_crop_the_copy_and_the_frame(tmp_path):
    cameras = read(folder(tmp_path, frame={"fl_x": 200.0})).cameras
    assert_near(cameras.intrinsics[0], [50, 55, 11.5, 12.5])
    assert_near(cameras.intrinsics[1, 0], 100)
    half = read(folder(tmp_path, size=(32, 24)), size=(24, 32)).cameras
    assert_near(half.intrinsics[0], [50, 55, 15.5, 12.5])


def test_missing_images_are_counted_and_named(tmp_path, caplog):
    folder(tmp_path)
    (tmp_path / "images/3.png").unlink()
    scene = read(tmp_path)
    assert scene.missing == [str(tmp_path / "images/3.png")]
    assert re.search(r"1 of 10.*3\.png", caplog.text)
    assert len(scene) == 9
    for i in set(range(10)) - {3, 5}:
        (tmp_path / f"images/{i}.png").unlink()
    must_not_find(r"\b10\b.*\b1\b", opened, tmp_path)


REFUSED = r"""
frame 1.*'file_path' | {"frame": {"file_path": null}}
frame 1 .*k6 | {"frame": {"k6": 0.001}}
frame 1 .*4 x 4 | {"frame": {"transform_matrix": [1, 2]}}
frame 1 \(images/1.png\).*NaN | {"frame": {"transform_matrix": [[NaN, 0, 0, 0], REST]}}
frame 1 .*not rigid | {"frame": {"transform_matrix": [[2, 0, 0, 0], REST]}}
frame 1 .*mirrored | {"frame": {"transform_matrix": [[-1, 0, 0, 0], REST]}}
focal | {"fl_x": null}
frame 0 .*pixels | {"fl_x": 1.2, "fl_y": 1.3, "cx": 0.5, "cy": 0.5}
EQUIRECTANGULAR | {"camera_model": "EQUIRECTANGULAR"}
k5 | {"camera_model": "OPENCV_FISHEYE", "k5": 0.1}
swapped | {"w": 48, "h": 64}
aspect | {"w": 48}
s1 | {"s1": 0.001}
k1 | {"k1": NaN}
""".replace("REST", "[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]")
"""What is told, and the changes of transforms.json, of all frames or of one."""


def test_what_cannot_be_meant_is_refused(tmp_path):
    for word, text in rows(REFUSED):
        must_refuse(word, opened, folder(tmp_path, count=2, **json.loads(text)))


def test_folders_and_files_that_are_not_there(tmp_path):
    must_not_find("does not exist", opened, tmp_path / "nothing")
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    must_not_find("qgs poses", opened, tmp_path)
    (tmp_path / "transforms.json").write_text("{")
    must_refuse("not valid JSON", opened, tmp_path)


def test_files_outside_of_the_folder_are_read_only_if_allowed(tmp_path):
    far = folder(tmp_path / "other") / "images/far.png"
    Image.new("RGB", (64, 48)).save(far)
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "linked").symlink_to(tmp_path / "other")  # a link in the folder is the user's own
    for of in ("depth_file_path", "mask_path", "file_path"):
        assert read(folder(mine, frame={of: "linked/images/far.png"}))
        for place in ("../other/images/far.png", str(far)):
            folder(mine, frame={of: place})
            must_refuse(r"other/images/far\.png", opened, mine)
            assert of != "file_path" or read(mine, outside=True)

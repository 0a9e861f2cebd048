"""`cameras.json` with c2w and K, or other names of them, and photos beside it."""

import json

import numpy as np
import pytest
import torch
from photo_formats import copied, scene, synthetic
from tables import fault

from qgs.data.photos import formats_of


@pytest.fixture
def photos(tmp_path):
    return synthetic(tmp_path / "photos")


def matrix(photos):
    fx, fy, cx, cy = photos.intrinsics
    return [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]


def cameras(photos, **more):
    return [{"c2w": pose.tolist(), "K": matrix(photos), **more} for pose in photos.c2w]


def named(photos, key="image", prefix=""):
    return [{key: prefix + f.name, **c} for f, c in zip(photos.files, cameras(photos), strict=True)]


FORMS = {
    "a list": lambda p: named(p),
    "frames": lambda p: {"frames": named(p, "file_path")},
    "names below images": lambda p: {"cameras": named(p, prefix="images/")},
    "names in images": lambda p: {"views": named(p, "name")},
    "no names": lambda p: cameras(p),
    "one K": lambda p: {"K": list(p.intrinsics), "c2w": [c[:3].tolist() for c in p.c2w]},
    "numbers of each": lambda p: {"K": [list(p.intrinsics)] * 6, "c2w": p.c2w.tolist()},
    "padded K": lambda p: {
        "c2w": p.c2w.tolist(),
        "K": np.vstack([np.c_[matrix(p), [0] * 3], [0, 0, 0, 1]]).tolist(),
    },
    "K of each": lambda p: {
        "c2w": p.c2w.tolist(),
        "K": [matrix(p)] * 6,
        "images": [file.name for file in p.files],
    },
    "a size": lambda p: {
        "w": 80, "h": 60,
        "frames": [{"c2w": c["c2w"], "K": [2 * v for v in p.intrinsics]} for c in cameras(p)],
    },
}  # fmt: skip


def renamed(photos, old, new, change=lambda value: value):
    others = [{key: value for key, value in c.items() if key != old} for c in named(photos)]
    return [{**o, new: change(c[old])} for o, c in zip(others, named(photos), strict=True)]


def parts(photos, value):
    """Intrinsics in parts of the width and height."""
    (height, width), matrix = photos.size, np.array(value)
    matrix[0] /= width
    matrix[1] /= height
    return matrix.tolist()


DIALECTS = {
    "views, intrinsic": lambda p: {"views": renamed(p, "K", "intrinsic")},
    "cam2world": lambda p: renamed(p, "c2w", "cam2world"),
    "w2c": lambda p: renamed(p, "c2w", "w2c", lambda pose: np.linalg.inv(pose).tolist()),
    "w2c of each": lambda p: {
        "world_to_camera": np.linalg.inv(p.c2w)[:, :3].tolist(), "intrinsics": list(p.intrinsics),
    },
    "OpenGL": lambda p: renamed(
        p, "c2w", "transform_matrix", lambda pose: (np.array(pose) * [1, -1, -1, 1]).tolist()
    ),
    "parts": lambda p: renamed(p, "K", "K", lambda value: parts(p, value)),
    "numbers by name": lambda p: [
        {"image": f.name, "c2w": c.tolist(), "fl_x": 50.0, "fl_y": 52.0, "cx": 19.0, "cy": 16.0}
        for f, c in zip(p.files, p.c2w, strict=True)
    ],
    "3DGS": lambda p: [
        {"id": 0, "img_name": f.stem, "width": 40, "height": 30, "fx": 50.0, "fy": 52.0,
         "position": c[:3, 3].tolist(), "rotation": c[:3, :3].tolist(), "cx": 19.0, "cy": 16.0}
        for f, c in zip(p.files, p.c2w, strict=True)
    ],
}  # fmt: skip


@pytest.mark.parametrize("form", [*FORMS, *DIALECTS])
def test_what_is_read_and_whether_its_meaning_is_logged(tmp_path, photos, form, caplog):
    folder = tmp_path / "scene"
    copied(photos, folder / ("images" if "images" in form else ""))
    content = (FORMS | DIALECTS)[form](photos)
    (folder / "cameras.json").write_text(json.dumps(content))
    read = scene(folder)
    torch.testing.assert_close(read.cameras.c2w, torch.from_numpy(photos.c2w))
    expected = torch.tensor(photos.intrinsics).double().expand(6, 4)
    torch.testing.assert_close(read.cameras.intrinsics, expected)
    assert [read.frame_name(i).split("/")[-1] for i in range(6)] == [f.name for f in photos.files]
    assert formats_of(folder) == ["cameras"]
    assert ("is read as" in caplog.text) == (form in DIALECTS)


def test_what_is_refused_names_the_file(tmp_path, photos):
    copied(photos, tmp_path / "scene")
    file = tmp_path / "scene" / "cameras.json"
    poses = photos.c2w.tolist()
    for content in (
        cameras(photos)[:4],
        [{"c2w": 1, "K": matrix(photos), "image": "a.png"}],
        [{"c2w": poses[0], "K": "x", "image": "a"}],
        {"K": [matrix(photos)] * 5, "c2w": poses},
        [*named(photos), 7],
        [{**camera, "K": None} for camera in named(photos)],
        renamed(photos, "c2w", "extrinsics"),
        renamed(photos, "c2w", "location"),
    ):
        file.write_text(json.dumps(content))
        assert not fault(r"cameras\.json", read_cameras, file.parent)


def read_cameras(folder):
    return scene(folder, format="cameras")


def test_four_numbers_a_camera_are_those_of_each(tmp_path, photos):
    folder = tmp_path / "scene"
    copied(photos, folder)
    for count in (5, 4, 3):
        sorted(folder.glob("*.png"))[count].unlink()
        rows = [[50.0 + i, 51.0, 16.0, 12.0] for i in range(count)]
        content = {"K": rows, "c2w": photos.c2w[:count].tolist()}
        (folder / "cameras.json").write_text(json.dumps(content))
        assert scene(folder).cameras.intrinsics.tolist() == rows


def test_no_more_of_a_listing_is_read_than_tells_what_it_is(tmp_path, photos):
    copied(photos, tmp_path / "scene")
    file = tmp_path / "scene" / "cameras.json"
    apart = {"c2w": photos.c2w.tolist(), "more": "x" * 200_000, "K": matrix(photos)}
    file.write_text(json.dumps(apart))
    assert formats_of(file.parent) == ["cameras"]
    with file.open("w") as opened:
        opened.write(json.dumps(named(photos)))
        opened.truncate(10**12)  # with a hole, which takes no space
    assert formats_of(file.parent) == ["cameras"]


def test_a_file_of_that_name_without_poses_is_named_where_photos_lie_beside_it(tmp_path, photos):
    copied(photos, tmp_path / "scene")
    file = tmp_path / "scene" / "cameras.json"
    file.write_text(json.dumps([{"id": 0, "position": [0, 0, 0]}] * 6))
    with pytest.raises(ValueError, match=r"cameras\.json"):
        scene(file.parent)
    for photo in file.parent.glob("*.png"):
        photo.unlink()
    assert formats_of(file.parent) == []

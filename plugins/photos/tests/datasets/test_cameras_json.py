"""`cameras.json` with c2w and K, or other names of them, and photos beside it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from photo_formats import copied, opengl, scene, synthetic
from tables import must_refuse, write_json
from torch.testing import assert_close

from qgs.data.photos import formats_of

LENS = [50.0, 52.0, 19.0, 16.0]
K = [[50.0, 0, 19.0], [0, 52.0, 16.0], [0, 0, 1]]
CENTRE = {"cx": 19.0, "cy": 16.0}


@pytest.fixture
def photos(tmp_path):
    return synthetic(tmp_path / "photos")


@pytest.fixture
def file(photos, tmp_path):
    """Where photos lie, and their cameras will."""
    copied(photos, tmp_path / "scene")
    return tmp_path / "scene/cameras.json"


def rows(columns, **shared):
    """A mapping for each photo."""
    values = zip(*columns.values(), strict=True)
    return [shared | dict(zip(columns, row, strict=True)) for row in values]


def forms(names, poses):
    """What is read; intrinsics in parts of the sides are told."""
    c2w = poses.tolist()
    plain = {"image": names, "c2w": c2w}
    below = {"image": [f"images/{name}" for name in names], "c2w": c2w}
    padded = np.vstack([np.c_[K, [0] * 3], [0, 0, 0, 1]]).tolist()
    doubled = rows({"c2w": c2w}, K=[2 * number for number in LENS])
    w2c = np.linalg.inv(poses)
    splats = {
        "img_name": [Path(name).stem for name in names],
        "position": poses[:, :3, 3].tolist(),
        "rotation": poses[:, :3, :3].tolist(),
    }
    return {
        "a list": rows(plain, K=K),
        "frames": {"frames": rows({"file_path": names, "c2w": c2w}, K=K)},
        "names below images": {"cameras": rows(below, K=K)},
        "names in images": {"views": rows({"name": names, "c2w": c2w}, intrinsic=K)},
        "no names": rows({"c2w": c2w}, K=K),
        "one K": {"K": LENS, "c2w": poses[:, :3].tolist()},
        "padded K": {"c2w": c2w, "K": padded},
        "K of each": {"c2w": c2w, "K": [K] * 6, "images": names},
        "a size": {"w": 80, "h": "60", "frames": doubled},
        "cam2world": rows({"image": names, "cam2world": c2w}, K=K),
        "w2c": rows({"image": names, "w2c": w2c.tolist()}, K=K),
        "w2c of each": {"world_to_camera": w2c[:, :3].tolist(), "intrinsics": LENS},
        "OpenGL": rows({"image": names, "transform_matrix": opengl(poses)}, K=K),
        "parts": rows(plain, K=(np.array(K) / [[40], [30], [1]]).tolist()),
        "numbers by name": rows(plain, fl_x=50.0, fl_y=52.0, **CENTRE),
        "3DGS": rows(splats, id=0, width=40, height=30, fx=50.0, fy=52.0, **CENTRE),
    }


def test_what_is_read(tmp_path, photos, caplog):
    names = [file.name for file in photos.files]
    for form, content in forms(names, photos.c2w).items():
        folder = tmp_path / form
        copied(photos, folder / ("images" if "images" in form else ""))
        write_json(folder / "cameras.json", content)
        caplog.clear()
        read = scene(folder)
        assert_close(read.cameras.c2w, torch.from_numpy(photos.c2w))
        assert_close(read.cameras.intrinsics, torch.tensor([LENS] * 6).double())
        assert [Path(read.frame_name(i)).name for i in range(6)] == names
        assert formats_of(folder) == ["cameras"]
        assert ("read as fractions" in caplog.text) == (form == "parts"), form


def test_what_is_refused_names_the_file(photos, file):
    names = [f.name for f in photos.files]
    c2w = photos.c2w.tolist()
    plain = {"image": names, "c2w": c2w}
    for content in (
        rows({"c2w": c2w[:4]}, K=K),
        [{"c2w": 1, "K": K, "image": "a.png"}],
        [{"c2w": c2w[0], "K": "x", "image": "a"}],
        {"K": [K] * 5, "c2w": c2w},
        [*rows(plain, K=K)[:1], 7],
        rows(plain, K=None),
        rows({"image": names, "extrinsics": c2w}, K=K),
        rows({"image": names, "location": c2w}, K=K),
    ):
        write_json(file, content)
        must_refuse(r"cameras\.json", scene, file.parent, format="cameras")


def test_four_numbers_a_camera_are_those_of_each(photos, file):
    for count in (5, 4, 3):
        sorted(file.parent.glob("*.png"))[count].unlink()
        lenses = [[50.0 + i, 51.0, 16.0, 12.0] for i in range(count)]
        write_json(file, {"K": lenses, "c2w": photos.c2w[:count].tolist()})
        assert scene(file.parent).cameras.intrinsics.tolist() == lenses


def test_no_more_of_a_listing_is_read_than_tells_what_it_is(photos, file):
    c2w = photos.c2w.tolist()
    write_json(file, {"c2w": c2w, "more": "x" * 200_000, "K": K})
    assert formats_of(file.parent) == ["cameras"]
    with file.open("w") as opened:
        opened.write(json.dumps(rows({"c2w": c2w}, K=K)))
        opened.truncate(10**12)  # with a hole, which takes no space
    assert formats_of(file.parent) == ["cameras"]


def test_a_file_of_that_name_without_poses_is_named_where_photos_lie_beside_it(file):
    write_json(file, [{"id": 0, "position": [0, 0, 0]}] * 6)
    must_refuse(r"cameras\.json", scene, file.parent)
    for photo in file.parent.glob("*.png"):
        photo.unlink()
    assert formats_of(file.parent) == []

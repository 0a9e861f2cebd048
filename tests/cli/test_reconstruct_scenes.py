"""`qgs reconstruct` of chunks and archives, and of one scene of many."""

import json
import zipfile

import numpy as np
import pytest
from PIL import Image
from qgs_datatools import packing
from upath import UPath

from qgs.cli.reconstruct import chosen_scene
from qgs.composer import resolve
from qgs.data import PhotosSource

SIZE = (16, 16)


def recipe(**data):
    return resolve({"recipe": 1, "plugins": ["rooms"], "data": {"image_size": [*SIZE], **data}})


@pytest.fixture
def folders(tmp_path):
    """Two scenes, a and b, of four photos."""
    for name in "ab":
        (tmp_path / "set" / name / "images").mkdir(parents=True)
        frames = []
        for i in range(4):
            Image.new("RGB", (24, 20), (10 * i, 0, 0)).save(
                tmp_path / "set" / name / "images" / f"{i}.png"
            )
            pose = np.eye(4)
            pose[0, 3] = i
            frames.append({"file_path": f"images/{i}.png", "transform_matrix": pose.tolist()})
        given = {"w": 24, "h": 20, "fl_x": 18, "fl_y": 18, "cx": 12, "cy": 10, "frames": frames}
        (tmp_path / "set" / name / "transforms.json").write_text(json.dumps(given))
    return tmp_path / "set"


@pytest.fixture
def chunks(folders, tmp_path):
    config = PhotosSource.Config(path=str(folders), image_size=SIZE, holdout=4)
    source = PhotosSource(config)
    packing.pack(source, packing.own_splits(source), UPath(tmp_path / "chunks"), {})
    return tmp_path / "chunks"


def test_one_scene_of_chunks(chunks):
    elsewhere = recipe(type="qgs/chunks", path=str(chunks.parent))
    scene, seen = chosen_scene(elsewhere, str(chunks), None, "b")
    assert (scene.name, len(scene), list(seen)) == ("b", 4, [])
    here = recipe(type="qgs/chunks", path=str(chunks))
    scene, seen = chosen_scene(here, str(chunks), (8, 12), "a")
    assert list(seen) == [0, 1, 3]
    assert tuple(scene.images([1]).shape[-2:]) == (8, 12)


def test_an_archive(folders, tmp_path):
    file = tmp_path / "zips" / f"{'0a' * 32}.zip"
    file.parent.mkdir()
    with zipfile.ZipFile(file, "w") as archive:
        for path in (folders / "a").rglob("*"):
            archive.write(path, path.relative_to(folders / "a"))
    scene, seen = chosen_scene(recipe(type="rooms/procedural"), str(file.parent), None, None)
    assert (scene.name, len(scene), list(seen)) == ("0a" * 32, 4, [])


def test_a_scene_that_is_not_named_or_not_there(folders):
    rooms = recipe(type="rooms/procedural")
    assert chosen_scene(rooms, str(folders), None, "b")[0].name == "b"
    with pytest.raises(ValueError, match="holds 2 scenes: a, b: name one of them with --scene"):
        chosen_scene(rooms, str(folders), None, None)
    with pytest.raises(ValueError, match="holds no scene 'c', but a, b: name one"):
        chosen_scene(rooms, str(folders), None, "c")

"""`qgs reconstruct` of photos in any format, chunks, archives and the data of a plugin."""

import json
import shutil
import zipfile
from functools import partial
from unittest.mock import Mock

import pytest
import tape_source
from commands import MODEL, run_qgs
from photo_formats import centred, synthetic, write_llff, write_nerfstudio
from PIL import Image
from qgs_datatools import packing
from upath import UPath

import qgs
from qgs.analysis.scenes import chosen_scene, whole_size
from qgs.composer import resolve
from qgs.data import PhotosSource

SIZE = (16, 16)


def recipe(**data):
    data = {"data": {"image_size": [*SIZE], **data}} if data else {}
    return resolve({"recipe": 1, "plugins": ["rooms", "datasets"], "model": MODEL, **data})


def chosen(trained, path, size=None, name=None):
    return chosen_scene(trained, str(path), size, name)


@pytest.fixture
def folders(tmp_path):
    """Two scenes, a and b, of four photos whose red is ten times their number."""
    photos = centred(synthetic(tmp_path / "photos", 4))
    for i, file in enumerate(photos.files):
        Image.new("RGB", (40, 30), (10 * i, 0, 0)).save(file)
    for name in "ab":
        write_nerfstudio(tmp_path / "set" / name, photos)
    write_llff(tmp_path / "llff", photos)
    return tmp_path / "set"


def test_photos_of_any_format_are_opened_for_a_model_of_other_data(folders):
    elsewhere = recipe(type="qgs/photos", path="elsewhere", format="nerfstudio", images="images_2")
    for trained in (elsewhere, recipe(type="rooms/procedural")):
        scene, seen = chosen(trained, folders.parent / "llff")
        assert scene.frame_name(2) == "images/view_002.png"
        assert (list(scene.held_out), list(seen)) == ([2], [])
        assert scene.images([2])[0, :, 3, 3].mul(255).round().tolist() == [20, 0, 0]


def test_a_scene_of_a_trained_set_is_known_for_what_it_is(folders):
    shutil.copytree(folders / "b", folders / "test" / "c")
    trained = recipe(type="qgs/photos", path=str(folders), holdout=3)
    for path, name in ((folders / "a", None), (folders, "a")):
        scene, seen = chosen(trained, path, name=name)
        assert (scene.held_out, list(seen)) == ((1,), [0, 2, 3])
    for other in (folders / "test" / "c", folders.parent / "llff"):
        scene, seen = chosen(trained, other)
        assert (scene.held_out, list(seen)) == ((2,), [])


@pytest.mark.parametrize(
    ("stored", "multiple", "whole"),
    [
        ((1280, 720), 4, (112, 64)),
        ((360, 540), 4, (64, 96)),
        ((30, 40), 16, (64, 80)),
        ((30, 40), None, (64, 64)),
        ((512, 512), 4, (64, 64)),
        (None, 4, (64, 64)),
    ],
)
def test_photos_of_another_kind_are_seen_whole(stored, multiple, whole):
    scene = Mock(cameras=Mock(size=(64, 64)), stored_size=lambda frame: stored)
    assert whole_size(scene, multiple) == whole


def test_the_whole_size_is_a_default(folders):
    trained = recipe(type="rooms/procedural")
    assert chosen(trained, folders.parent / "llff")[0].cameras.size == (16, 24)
    assert chosen(trained, folders.parent / "llff", SIZE)[0].cameras.size == SIZE
    trained = recipe(type="qgs/photos", path=str(folders))
    assert chosen(trained, folders / "a")[0].cameras.size == SIZE


def test_one_scene_of_chunks(folders, tmp_path):
    source = PhotosSource(PhotosSource.Config(path=str(folders), image_size=SIZE, holdout=4))
    chunks = tmp_path / "chunks"
    packing.pack(source, packing.own_splits(source), UPath(chunks), {})
    scene, seen = chosen(recipe(type="datasets/chunks", path=str(tmp_path)), chunks, name="b")
    assert (scene.name, len(scene), list(seen)) == ("b", 4, [])
    scene, seen = chosen(recipe(type="datasets/chunks", path=str(chunks)), chunks, (8, 12), "a")
    assert list(seen) == [0, 1, 3]
    assert tuple(scene.images([1]).shape[-2:]) == (8, 12)


def test_an_archive(folders, tmp_path):
    file = tmp_path / "zips" / f"{'0a' * 32}.zip"
    file.parent.mkdir()
    with zipfile.ZipFile(file, "w") as archive:
        for path in (folders / "a").rglob("*"):
            archive.write(path, path.relative_to(folders / "a"))
    scene, seen = chosen(recipe(type="rooms/procedural"), file.parent)
    assert (scene.name, len(scene), list(seen)) == ("0a" * 32, 4, [])


def test_a_scene_that_is_not_named_or_not_there(folders, tmp_path):
    opened = partial(chosen, recipe(type="rooms/procedural"), folders)
    assert opened(name="b")[0].name == "b"
    with pytest.raises(ValueError, match="holds 2 scenes: a, b: name one of them with --scene"):
        opened()
    with pytest.raises(ValueError, match="holds no scene 'c', but a, b: name one"):
        opened(name="c")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "transforms.txt").touch()
    with pytest.raises(FileNotFoundError, match="lists no cameras"):
        chosen(recipe(type="rooms/procedural"), tmp_path / "empty")


def test_a_recipe_without_data_takes_the_size_that_is_given(folders):
    with pytest.raises(ValueError, match="such as --size 256x256"):
        chosen(recipe(), folders / "a")
    for trained in (
        recipe(),
        recipe(type="rooms/procedural"),
        recipe(type="qgs/photos", path=str(folders / "a")),
    ):
        scene, _ = chosen(trained, folders / "a", (8, 24))
        assert scene.images([2]).shape == (1, 3, 8, 24)


@pytest.mark.parametrize("data", ["rooms/procedural", "tapes/tape"])
def test_the_data_of_a_plugin(tmp_path, monkeypatch, data):
    tape_source.install(tmp_path / "site", monkeypatch)
    for name in "ab":
        tape_source.write_tape(tmp_path / "tapes" / f"{name}.tape")
    own = {"path": str(tmp_path / "tapes")} if data == "tapes/tape" else {}
    trained = {
        "recipe": 1,
        "plugins": [data.partition("/")[0]],
        "model": MODEL,
        "data": {"type": data, "image_size": [*SIZE], **own},
        "views": {"inputs": 2, "targets": 2, "gap": [2, 4]},
    }
    file = tmp_path / "checkpoint.safetensors"
    qgs.save(qgs.compose(trained), file)
    views = ("--scene", "b", "--frames", "0,5", "--holdout", "1,2")
    result = run_qgs("reconstruct", file, tmp_path / "tapes", "--out", tmp_path / "out", *views)
    assert result.exception is None, result.output
    views = json.loads((tmp_path / "out" / "cameras.json").read_text())["views"]
    last = "seen in training" if own else "novel"
    assert [view["kind"] for view in views] == ["input", "input", "novel", last]

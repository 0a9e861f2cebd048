"""Which scene of photos in any format, or of chunks, is reconstructed, and what it holds out."""

import shutil

import pytest
from commands import ONE_LAYER
from photo_formats import centred, opened, put, synthetic, write_llff, write_nerfstudio
from PIL import Image
from qgs_photos.datatools import packing
from tables import must_not_find, must_refuse
from upath import UPath

from qgs.recipe import resolve
from qgs.reconstruction.scenes import chosen_scene

SIZE = (16, 16)
WHOLE = (16, 24)


def recipe(kind, **options):
    data = {"type": kind, "image_size": [*SIZE], **options}
    return resolve(ONE_LAYER | {"data": data}, ["plugins=[rooms, datasets]"])


ROOMS = recipe("rooms/procedural")
NO_DATA = resolve(ONE_LAYER)


def chosen(trained, path, size=None, name=None):
    """Photos of the scene that are held out, those that were trained on, and their size."""
    scene, seen = chosen_scene(trained, str(path), size, name)
    return tuple(scene.held_out), tuple(seen or ()), scene.cameras.size


@pytest.fixture
def folders(tmp_path):
    """Two scenes, a and b, of four photos whose red is ten times their number; ../llff is a."""
    photos = centred(synthetic(tmp_path / "photos", 4))
    for i, file in enumerate(photos.files):
        Image.new("RGB", (40, 30), (10 * i, 0, 0)).save(file)
    for name in "ab":
        write_nerfstudio(tmp_path / "set" / name, photos)
    write_llff(tmp_path / "llff", photos)
    return tmp_path / "set"


def test_photos_of_any_format_are_opened_for_a_model_of_other_data(folders):
    """Whole, unless a size is given."""
    llff = folders.parent / "llff"
    elsewhere = recipe("qgs/photos", path="elsewhere", format="nerfstudio", images="images_2")
    for trained in (elsewhere, ROOMS):
        assert chosen(trained, llff) == ((2,), (), WHOLE)
        assert chosen(trained, llff, SIZE) == ((2,), (), SIZE)
    scene, _ = chosen_scene(elsewhere, str(llff), None, None)
    assert scene.frame_name(2) == "images/view_002.png"
    assert scene.images([2])[0, :, 3, 3].mul(255).round().tolist() == [20, 0, 0]


def test_a_scene_of_a_trained_set_is_known_for_what_it_is(folders):
    shutil.copytree(folders / "b", folders / "test/c")
    trained = recipe("qgs/photos", path=str(folders), holdout=3)
    for path, name in ((folders / "a", None), (folders, "a")):
        assert chosen(trained, path, name=name) == ((1,), (0, 2, 3), SIZE)
    for other in (folders / "test/c", folders.parent / "llff"):
        assert chosen(trained, other)[:2] == ((2,), ())


def test_one_scene_of_chunks(folders, tmp_path):
    chunks = tmp_path / "chunks"
    source = opened(folders, SIZE, holdout=4)
    packing.pack(source, packing.chosen_splits(source), UPath(chunks), {})
    trained = recipe("datasets/chunks", path=str(chunks))
    assert chosen(trained, chunks, (8, 12), "a") == ((2,), (0, 1, 3), (8, 12))
    elsewhere = recipe("datasets/chunks", path=str(tmp_path))
    assert chosen(elsewhere, chunks, name="b") == ((2,), (), WHOLE)


def test_a_scene_that_is_not_named_or_not_there(folders, tmp_path):
    must_refuse(r"holds 2 scenes: a, b: name one of them as `scene`", chosen, ROOMS, folders)
    must_refuse("holds no scene 'c', but a, b: name one", chosen, ROOMS, folders, name="c")
    put(tmp_path / "empty/transforms.txt", b"")
    must_not_find("lists no cameras", chosen, ROOMS, tmp_path / "empty")


def test_a_recipe_without_data_takes_the_size_that_is_given(folders):
    must_refuse("give `size`, such as 256x256", chosen, NO_DATA, folders / "a")
    for trained in (NO_DATA, recipe("qgs/photos", path=str(folders / "a"))):
        assert chosen(trained, folders / "a", (8, 24))[2] == (8, 24)

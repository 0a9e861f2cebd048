"""`qgs reconstruct` of folders other than nerfstudio's, and of a scene among many."""

import shutil

import numpy as np
import pytest
from PIL import Image

from qgs.cli.reconstruct import photos_config, scene_of, was_trained_on
from qgs.composer import resolve
from qgs.data import PhotosSource

MODEL = {
    "width": 16,
    "heads": 2,
    "encoder": {"type": "qgs/multiview_vit", "patch_size": 8, "depth": 1},
    "queries": {"type": "qgs/latent", "count": 8},
    "decoder": {"depth": 1},
    "head": {"type": "qgs/gaussian_head"},
    "supervision": {"type": "qgs/layers", "layers": [1]},
}


def recipe(**data):
    return resolve(
        {
            "recipe": 1,
            "plugins": ["rooms"],
            "model": MODEL,
            "data": {"image_size": [16, 16], **data},
        }
    )


@pytest.fixture
def scene(tmp_path):
    """An LLFF scene of four photos, the folder `a` of a folder of scenes."""
    folder = tmp_path / "set" / "a"
    (folder / "images").mkdir(parents=True)
    rows = np.zeros((4, 17))
    for i in range(4):
        Image.new("RGB", (24, 20), (10 * i, 0, 0)).save(folder / "images" / f"{i}.png")
        axes = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
        rows[i, :15] = np.column_stack([axes, [i, 0, 0], [20, 24, 18]]).ravel()
    np.save(folder / "poses_bounds.npy", rows)
    return folder


def test_photos_of_any_format_are_opened_for_a_model_of_other_data(scene):
    trained = recipe(type="qgs/photos", path="elsewhere", format="nerfstudio", images="images_2")
    for source in (trained, recipe(type="rooms/procedural")):
        config = photos_config(source, str(scene))
        opened = scene_of(PhotosSource(config), str(scene), None)
        assert opened.frame_name(2) == "images/2.png"
        assert len(opened.held_out) == 0
        assert opened.images([2])[0, :, 3, 3].mul(255).round().tolist() == [20, 0, 0]


def test_a_scene_of_a_trained_set_is_known_for_what_it_is(scene):
    shutil.copytree(scene, scene.parent / "test" / "b")
    trained = recipe(type="qgs/photos", path=str(scene.parent), holdout=3)
    assert was_trained_on(trained, str(scene))
    assert photos_config(trained, str(scene)).holdout == 3
    assert not was_trained_on(trained, str(scene.parent / "test" / "b"))
    assert not was_trained_on(trained, str(scene.parent.parent / "other"))


def test_several_scenes_are_refused(scene):
    shutil.copytree(scene, scene.parent / "b")
    root = str(scene.parent)
    with pytest.raises(ValueError, match="holds 2 scenes"):
        scene_of(PhotosSource(photos_config(recipe(type="rooms/procedural"), root)), root, None)


def test_files_of_no_format_are_told(tmp_path):
    (tmp_path / "transforms.txt").write_text("{}")
    with pytest.raises(FileNotFoundError, match=r"no transforms\.json nor another listing"):
        PhotosSource(photos_config(recipe(type="rooms/procedural"), str(tmp_path)))


def test_a_recipe_without_data_takes_the_size_that_is_given(scene):
    imported = resolve({"recipe": 1, "plugins": ["rooms"], "model": MODEL})
    with pytest.raises(ValueError, match="such as --size 256x256"):
        photos_config(imported, str(scene))
    for source in (
        imported,
        recipe(type="rooms/procedural"),
        recipe(type="qgs/photos", path=str(scene)),
    ):
        config = photos_config(source, str(scene), (8, 24))
        opened = scene_of(PhotosSource(config), str(scene), None)
        assert opened.images([2]).shape == (1, 3, 8, 24)

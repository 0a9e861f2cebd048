"""The search for the image size of photos: which sizes it tries, and which one it takes."""

from types import SimpleNamespace

import pytest
import torch
import yaml
from commands import ONE_LAYER
from photo_formats import centred, synthetic, write_nerfstudio
from walk import Walk, arc, pinhole

from qgs.contracts import ViewsConfig
from qgs.data.samples import make_sample
from qgs.recipe import resolve
from qgs.reconstruction.scale import find_size, half
from qgs.reconstruction.scenes import chosen_scene


class Grey(Walk):
    """Grey photos of 16 pixels."""

    cameras = pinhole(arc(range(-30, 31, 12), 3), size=(16, 16))

    def images(self, frames):
        return torch.full((len(frames), 3, *self.cameras.size), 0.5)


class Painter:
    """A model whose renderings are off by an error that depends on the side of the photos."""

    device = torch.device("cpu")
    encoder = SimpleNamespace(config=None, size_multiple=lambda config: 8)

    def __init__(self, errors):
        self.errors = errors

    def __call__(self, views):
        return SimpleNamespace(gaussians=views.cameras.size)

    def render(self, gaussians, cameras):
        size = cameras.size
        return SimpleNamespace(rgb=torch.full((1, 2, 3, *size), 0.5 + self.errors[size[0]]))


@pytest.fixture(autouse=True)
def small_photos_are_large_enough(monkeypatch):
    monkeypatch.setattr("qgs.reconstruction.scale.LEAST", 8)


def found_of(errors, compared, scene):
    return find_size(Painter(errors), scene, (1, 4), compared, ViewsConfig())


def test_the_better_size_is_taken_and_the_larger_of_equal_ones():
    for errors, best in (({8: 0.1, 16: 0.2}, 8), ({8: 0.2, 16: 0.1}, 16), ({8: 0.1, 16: 0.1}, 16)):
        found = found_of(errors, (2,), Grey())
        assert found.halved == (best == 8)
        assert found.gaussians == (best, best)
        assert found.text.startswith(f"size {best} x {best}: ")
        assert "photos/01.png, photos/04.png" in found_of(errors, (0, 2, 3, 5), Grey()).text


def test_a_sample_without_targets_is_halved_and_a_moving_scene_is_not():
    errors = {8: 0.1, 16: 0.2}
    sample = make_sample(Grey(), (1, 4), (), ViewsConfig())
    small = half(sample, Painter(errors))
    assert small.inputs.images.shape == (1, 2, 3, 8, 8)
    assert small.targets.images.shape == (1, 0, 3, 8, 8)
    moving = Grey()
    moving.times = torch.arange(len(moving)).double()
    assert found_of(errors, (2,), moving) is None


SIZES = """
- [16, [30, 40], [16, 24]]
- [64, [118, 180], [64, 96]]
- [128, [200, 300], [128, 192]]
- [128, [300, 400], [256, 336]]
- [256, [300, 400], [256, 336]]
"""
"""Side in the training, size of the photos, size at which they are read."""


def test_photos_are_never_enlarged_nor_larger_than_256(tmp_path):
    for trained, stored, expected in yaml.safe_load(SIZES):
        write_nerfstudio(tmp_path, centred(synthetic(tmp_path / "photos", 4, stored)))
        data = {"type": "rooms/procedural", "image_size": [trained, trained]}
        recipe = resolve(ONE_LAYER | {"plugins": ["rooms"], "data": data})
        scene, _ = chosen_scene(recipe, str(tmp_path), None, None)
        assert [*scene.cameras.size] == expected, (trained, stored)

"""The search for the image size of photos: which sizes it tries, and which one it takes."""

from types import SimpleNamespace

import pytest
import torch
from commands import MODEL
from photo_formats import centred, synthetic, write_nerfstudio
from walk import Walk, arc, pinhole

from qgs.contracts import ViewsConfig
from qgs.recipe import resolve
from qgs.reconstruction.scenes import at_sizes, chosen_scene
from qgs.reconstruction.size import find_size


class Grey(Walk):
    """Grey photos of `side` pixels."""

    def __init__(self, side):
        self.cameras = pinhole(arc(range(-30, 31, 12), 3), size=(side, side))

    def images(self, frames):
        return torch.full((len(frames), 3, *self.cameras.size), 0.5)


class Painter(torch.nn.Linear):
    """A model whose renderings are off by an error that depends on the side of the photos."""

    def __init__(self, errors):
        super().__init__(1, 1)
        self.errors = errors

    def forward(self, views):
        return SimpleNamespace(gaussians=views.cameras.size)

    def render(self, gaussians, cameras):
        size = cameras.size
        return SimpleNamespace(rgb=torch.full((1, 2, 3, *size), 0.5 + self.errors[size[0]]))


@pytest.mark.parametrize(
    ("errors", "best"),
    [({8: 0.1, 16: 0.2}, 8), ({8: 0.2, 16: 0.1}, 16), ({8: 0.1, 16: 0.1}, 16)],
)
def test_the_best_size_is_taken_and_the_larger_of_equal_ones(errors, best):
    scenes = [Grey(8), Grey(16)]
    found = find_size(Painter(errors), scenes, (1, 4), (2,), ViewsConfig())
    assert found.scene.cameras.size == found.gaussians == (best, best)
    assert len(found.names) == 2
    assert [size[0] for size, _ in found.tried] == [best, 24 - best]
    assert found.text.startswith(f"size {best} x {best}: ")
    inputs = find_size(Painter(errors), scenes, (1, 4), (0, 2, 3, 5), ViewsConfig()).names
    assert inputs == ["photos/01.png", "photos/04.png"]


def test_photos_are_never_enlarged_nor_larger_than_256(tmp_path):
    for trained, stored, expected in (
        (16, (30, 40), [(16, 24), (32, 40)]),
        (16, (40, 60), [(16, 24), (32, 48)]),
        (16, (18, 24), [(16, 24)]),
        (160, (600, 900), [(160, 240), (256, 384)]),
        (256, (600, 900), [(256, 384)]),
    ):
        folder = tmp_path / f"{trained}{stored}"
        write_nerfstudio(folder, centred(synthetic(folder / "photos", 4, stored)))
        data = {"type": "rooms/procedural", "image_size": [trained, trained]}
        recipe = resolve({"recipe": 1, "plugins": ["rooms"], "model": MODEL, "data": data})
        scene, _ = chosen_scene(recipe, str(folder), None, None)
        sizes = [one.cameras.size for one in at_sizes(recipe, str(folder), scene, None)]
        assert sizes == expected

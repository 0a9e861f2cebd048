"""`model.reconstruct` and `qgs.read_photos`; a model given views in another world warns."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import run_qgs
from photo_formats import noisy_photos
from PIL import Image
from varying_head import VaryingHead

import qgs
from qgs.geometry.poses import look_at
from qgs.io.gaussians import load_ply
from qgs.renderers import AutoRenderer
from qgs.types import Cameras, Views, map_tensors

RECIPE = {
    "recipe": 1,
    "model": {
        "width": 32,
        "heads": 2,
        "queries": {"count": 8},
        "decoder": {"depth": 1},
        "head": {"gaussians_per_query": 4},
        "supervision": {"layers": [1]},
    },
    "data": {"type": "qgs/photos", "path": "nowhere", "image_size": [16, 24]},
    "views": {"inputs": 2, "gap": [2, 4], "scale": "distance", "scale_factor": 0.5},
}


@pytest.fixture(scope="module")
def model():
    return qgs.compose(RECIPE).eval()


@pytest.fixture
def photos(tmp_path):
    return noisy_photos(tmp_path / "photos", step=5.0)


def somewhere(count: int = 3) -> Views:
    """Photos by cameras far from the origin, in units of which 100 lie between neighbours."""
    generator = torch.Generator().manual_seed(1)
    eyes = torch.tensor([[700.0, -300.0, 50.0]]) + 100 * torch.rand(count, 3, generator=generator)
    c2w = look_at(eyes, torch.tensor([-1.0, 0.3, 0.1]).expand(count, 3), torch.tensor([0.0, 0, -1]))
    lens = torch.tensor([20.0, 20.0, 12.0, 8.0]).expand(1, count, 4)
    images = torch.rand(1, count, 3, 16, 24, generator=generator)
    return Views(images, Cameras(c2w[None], lens, (16, 24)))


def test_a_folder_is_reconstructed_as_by_the_command(model, photos, tmp_path):
    qgs.save(model, tmp_path / "model.safetensors")
    options = ("--frames", "1,5", "--set", "views.scale=auto")
    done = run_qgs(
        "reconstruct", tmp_path / "model.safetensors", photos, "--out", tmp_path / "a", *options
    )
    assert done.exception is None
    loaded = qgs.load(tmp_path / "model.safetensors")
    result = loaded.reconstruct(photos, frames=[1, "5.png"], overrides=["views.scale=auto"])
    result.save(tmp_path / "b")
    for name in ("gaussians.ply", "cameras.json"):
        assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "a" / name).read_bytes()
    one, other = (sorted(f.name for f in (tmp_path / x).iterdir()) for x in "ab")
    assert one == other
    assert result._repr_png_().startswith(b"\x89PNG")


def test_views_in_any_world_give_the_same_scene(model, caplog):
    views = somewhere()
    result = model.reconstruct(views)
    inputs = result.sample.inputs
    torch.testing.assert_close(inputs.cameras.c2w[0, 0], torch.eye(4), atol=1e-5, rtol=0)
    spread = inputs.cameras.c2w[0, :, :3, 3].norm(dim=-1).max()
    assert float(spread) == pytest.approx(0.5, rel=1e-4)
    assert caplog.text == ""
    assert result.prediction is not None
    torch.testing.assert_close(result.prediction.gaussians.means, model(inputs).gaussians.means)
    turn = look_at(torch.tensor([3.0, 1, 2]), torch.tensor([1.0, 2, 3]), torch.tensor([0.0, 1, 0]))
    c2w = turn @ views.cameras.c2w
    c2w[..., :3, 3] *= 0.01
    moved = Views(views.images, Cameras(c2w, views.cameras.intrinsics, views.cameras.size))
    again = model.reconstruct(moved)
    torch.testing.assert_close(again.gaussians.means, result.gaussians.means, atol=1e-3, rtol=1e-3)


def test_gaussians_lie_in_the_world_of_the_photos(model, tmp_path):
    views = somewhere()
    result = model.reconstruct(views)
    placed = result.in_photos_world
    qgs.save_ply(placed, tmp_path / "placed.ply")
    renderer = AutoRenderer(AutoRenderer.Config())
    seen = renderer(qgs.load_ply(tmp_path / "placed.ply"), views.cameras)
    own = model.render(result.gaussians, result.sample.inputs.cameras)
    asked = result.render(views.cameras)
    factor = float(result.world[1])
    for rendering in (seen, asked):
        torch.testing.assert_close(rendering.rgb, own.rgb, atol=5e-3, rtol=0)
        torch.testing.assert_close(rendering.depth * factor, own.depth, atol=5e-3, rtol=1e-2)
    assert float((own.rgb - 1).abs().max()) > 0.05, "there is something to see"


def test_harmonics_are_turned_into_the_world_of_the_photos(model, tmp_path, monkeypatch):
    monkeypatch.setattr(model, "head", VaryingHead(model.head).eval())
    views = somewhere()
    result = model.reconstruct(views)
    assert result.gaussians.sh is not None
    own = model.render(result.gaussians, result.sample.inputs.cameras).rgb
    with torch.no_grad():
        plain = model.render(replace(result.gaussians, sh=None), result.sample.inputs.cameras).rgb
    assert (own - plain).abs().max() > 0.02, "there is something to turn"
    torch.testing.assert_close(result.render(views.cameras).rgb, own, atol=5e-3, rtol=0)
    qgs.save_ply(result.in_photos_world, tmp_path / "placed.ply")
    far = AutoRenderer(AutoRenderer.Config(far=1e5))  # in the unit of the photos
    again = far(load_ply(tmp_path / "placed.ply"), views.cameras)
    torch.testing.assert_close(again.rgb, own, atol=5e-3, rtol=0)
    result.save(tmp_path / "saved")
    assert torch.equal(load_ply(tmp_path / "saved" / "gaussians.ply").sh, result.gaussians.sh)
    assert result.save(tmp_path / "one.ply") == [tmp_path / "one.ply"]
    assert (tmp_path / "one.ply").read_bytes() == (tmp_path / "placed.ply").read_bytes()


def test_what_cannot_be_reconstructed_is_refused(model, photos):
    views = somewhere()
    two = map_tensors(lambda tensor: torch.cat([tensor, tensor]), views)
    for given, options, word in (
        (Views(views.images * 255, views.cameras), {}, "255"),
        (two, {}, "one scene"),
        (views, {"size": (16, 24)}, "folders"),
        (views, {"overrides": ["seed=1"]}, "seed=1"),
        (photos, {"frames": ["9.png"]}, r"9\.png"),
    ):
        with pytest.raises(ValueError, match=word):
            model.reconstruct(given, **options)
    by_hand = qgs.compose(RECIPE)
    by_hand.recipe = None
    with pytest.raises(ValueError, match="recipe"):
        by_hand.reconstruct(views)


def test_photos_are_read_in_their_own_world_and_size(photos):
    views = qgs.read_photos(photos)
    assert views.images.shape == (1, 7, 3, 20, 24)
    stored = np.asarray(Image.open(photos / "images/3.png"))
    np.testing.assert_allclose(views.images[0, 3].permute(1, 2, 0) * 255, stored, atol=0.01)
    assert views.cameras.intrinsics[0, 0].tolist() == [20, 20, 12, 10]
    centres = views.cameras.c2w[0, :, :3, 3]
    torch.testing.assert_close((centres[1:] - centres[:-1]).norm(dim=-1), torch.full((6,), 5.0))
    few = qgs.read_photos(photos, size=(10, 12), frames=["2.png", 0])
    assert few.images.shape == (1, 2, 3, 10, 12)
    torch.testing.assert_close(few.cameras.c2w[0], views.cameras.c2w[0, [2, 0]])
    with pytest.raises(FileNotFoundError):
        qgs.read_photos(photos / "nothing")


@pytest.fixture
def loaded(tmp_path):
    """A function that loads a model whose training saw baselines of 0.1 to 0.5."""
    ranges = {"samples": 4, "ranges": {"baseline": [0.1, 0.5]}}
    file = tmp_path / "m.safetensors"
    qgs.save(qgs.compose(RECIPE), file, extra={"trained_on": json.dumps(ranges)})
    return lambda: qgs.load(file)


def test_a_loaded_model_checks_the_first_views_that_it_reconstructs(loaded, caplog):
    views, model = somewhere(), loaded().train()
    model(views)
    assert caplog.text == "", "in training nothing is looked at"
    model.eval()
    model(views)
    model(views)
    assert caplog.text.count("not at the origin of the model's world") == 1
    caplog.clear()
    own = loaded().reconstruct(views).sample.inputs
    loaded()(own)
    assert caplog.text == ""
    opengl = own.cameras.c2w * torch.tensor([1.0, -1, -1, 1])
    far = own.cameras.c2w.clone()
    far[..., :3, 3] *= 200
    for images, c2w, words in (
        (own.images, opengl, "negate columns 1, 2"),
        (own.images * 255, own.cameras.c2w, "images have values from"),
        (own.images, far, "in training at most 0.5"),
    ):
        caplog.clear()
        loaded()(Views(images, Cameras(c2w, own.cameras.intrinsics, own.cameras.size)))
        assert words in caplog.text

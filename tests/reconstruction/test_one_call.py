"""`qgs.reconstruct` and `qgs.read_photos`; a model given views in another world warns."""

import pytest
import torch
import yaml
from commands import ONE_LAYER
from photo_formats import scene
from tables import assert_equal, assert_near, must_not_find, must_refuse
from torch.testing import assert_close
from varying_head import VaryingHead

import qgs
from qgs.containers import concatenated
from qgs.geometry.poses import look_at, scaled
from qgs.renderers import AutoRenderer
from qgs.types import Views

REST = """
data: {type: qgs/photos, path: nowhere, image_size: [16, 24]}
views: {inputs: 1, scale: distance, scale_factor: 0.5}
"""
RECIPE = ONE_LAYER | yaml.safe_load(REST)
POSE = look_at(
    torch.tensor([7.0, -3, 0.5]), torch.tensor([-1, 0.3, 0.1]), torch.tensor([0.0, 0, -1])
)


@pytest.fixture(scope="module")
def model():
    return qgs.compose(RECIPE).eval()


@pytest.fixture
def far(views):
    """The views by cameras far from the origin, in units of which 30 lie between them."""
    return views.replace(cameras=views.cameras.replace(c2w=scaled(POSE @ views.cameras.c2w, 100)))


def test_views_in_any_world_give_the_same_scene(model, views, far, caplog):
    result = qgs.reconstruct(model.train(), far)
    assert model.training  # as before
    model.eval()
    inputs = result.sample.inputs
    assert result.sample.input_frames == (0, 1)  # all of them
    assert_close(inputs.cameras.c2w[0, 0], torch.eye(4))
    assert_near(inputs.cameras.c2w[0, 1, :3, 3].norm(), 0.5, rtol=1e-4)
    assert not caplog.text
    assert_close(result.gaussians.means, model(inputs).gaussians.means)
    again = qgs.reconstruct(model, views)
    assert_close(again.gaussians.means, result.gaussians.means, atol=1e-3, rtol=1e-3)
    assert result._repr_png_().startswith(b"\x89PNG")


def test_gaussians_with_harmonics_lie_in_the_world_of_the_photos(model, far, tmp_path, monkeypatch):
    monkeypatch.setattr(model, "head", VaryingHead(model.head).eval())
    result = qgs.reconstruct(model, far)
    inputs = result.sample.inputs.cameras
    own = model.render(result.gaussians, inputs)
    plain = model.render(result.gaussians.replace(sh=None), inputs)
    assert (own.rgb - plain.rgb).abs().max() > 0.02  # there is something to turn
    file = tmp_path / "placed.ply"
    assert result.save(file) == [file]
    renderer = AutoRenderer(AutoRenderer.Config(far=1e5))  # in the unit of the photos
    for seen in (renderer(qgs.load_ply(file), far.cameras), result.render(far.cameras)):
        assert_equal(seen.rgb, own.rgb, atol=5e-3)
        assert_close(seen.depth * float(result.sample.world[1]), own.depth, atol=5e-3, rtol=1e-2)


def test_what_cannot_be_reconstructed_is_refused(model, views, photos):
    two = concatenated([views, views], 0)
    by_hand = qgs.compose(RECIPE)
    by_hand.recipe = None
    for chosen, given, options, word in (
        (model, Views(views.images * 255, views.cameras), {}, "255"),
        (model, two, {}, "one scene"),
        (model, views, {"size": (16, 24)}, "folders"),
        (model, views, {"overrides": ["seed=1"]}, "seed=1"),
        (model, photos, {"frames": ["9.png"]}, r"9\.png"),
        (by_hand, views, {}, "recipe"),
    ):
        must_refuse(word, qgs.reconstruct, chosen, given, **options)


def test_photos_are_read_in_their_own_world_and_size(photos):
    views = qgs.read_photos(photos)
    assert_equal(views.images[0], scene(photos, (20, 24)).images(range(7)))
    assert views.cameras.intrinsics[0, 0].tolist() == [20, 20, 12, 10]
    assert_near(views.cameras.c2w[0, :, 0, 3], [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    few = qgs.read_photos(photos, size=(10, 12), frames=["2.png", 0])
    assert few.images.shape == (1, 2, 3, 10, 12)
    assert_equal(few.cameras.c2w, views.cameras.c2w[:, [2, 0]])
    must_not_find("nothing", qgs.read_photos, photos / "nothing")

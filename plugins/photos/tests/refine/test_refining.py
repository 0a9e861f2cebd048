"""Refinement brings Gaussians nearer to the photos of their scene; the clock is a fake."""

import math
import os
import signal
from functools import partial
from itertools import count

import pytest
import torch
from qgs_photos.refine import refine
from qgs_photos.refine.adjusting import Adjustments
from qgs_photos.refine.growth import FreeGaussians
from qgs_photos.refine.refining import Extras
from qgs_photos.refine.scene import masked
from qgs_photos.refine.surroundings import edge_color, surrounded
from qgs_photos.refine.sweeping import swept
from qgs_photos.viewing import VIEWER
from tables import assert_equal, must_refuse
from test_evidence import shots
from textured_room import INTRINSICS, photos_of, walk
from torch.testing import assert_close
from walk import assert_rigid, cloud

from qgs.containers import map_tensors
from qgs.data.samples import shrunk
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.metrics.images import psnr
from qgs.renderers import AutoRenderer
from qgs.types import Views

RENDERER = AutoRenderer(AutoRenderer.Config())


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """Every step takes a second; a function given to this is called at each reading."""
    hooks = []
    readings = count()

    def read():
        now = next(readings)
        for hook in hooks:
            hook(now)
        return float(now)

    monkeypatch.setattr("qgs_photos.refine.refining.perf_counter", read)
    return hooks.append


def photos(views, side=24, number=60):
    """Photos (1, views) of a cloud, from a quarter of a circle."""
    return shots(cloud(number), torch.linspace(0, 90, views), side, RENDERER)


@torch.no_grad()
def mean_psnr(gaussians, views):
    rgb = RENDERER(gaussians.replace(features=None), views.cameras).rgb
    return float(psnr(rgb[0], views.images[0]).mean())


def free(gaussians):
    """Parameters that are learnt with one rate, whatever is given."""
    names = ("means", "log_scales", "quats", "opacity_logits", "colors", "sh")
    return FreeGaussians(gaussians, dict.fromkeys(names, 1e-2))


def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="module")
def scene():
    """Photos to optimise on, and others between them."""
    every = photos(9)
    return every.select([0, 1, 3, 4, 5, 7, 8]), every.select([2, 6])


def test_photos_that_are_not_optimised_on_are_met_better(scene, monkeypatch):
    views, compared = scene
    start = cloud(40, seed=1)
    before = start.means.clone()
    result, again = (refine(start, views, 100) for _ in range(2))
    refined = result.gaussians
    assert_equal(refined.means, again.gaussians.means)
    assert_equal(start.means, before)
    assert result.steps == 100  # the first, in which kernels compile, is not counted; the sweep is
    assert mean_psnr(refined, compared) > mean_psnr(start, compared) + 6
    assert not refined.means.requires_grad
    assert refined.sh is refined.features is None
    assert torch.allclose(refined.quats.norm(dim=-1), torch.ones(()))
    # the result is not that of the last step
    monkeypatch.setattr("qgs_photos.refine.refining._AVERAGED", 2)
    assert not refine(start, views, 100).gaussians.means.equal(refined.means)


def test_there_are_as_many_as_wanted(scene):
    start = cloud(30)
    for wanted in (90, 12, 30):
        assert refine(start, scene[0], 30, count=wanted).gaussians.count == wanted
    two_steps = refine(start, scene[0], 1.5, count=12).gaussians.opacities[:, :6]
    most_opaque = start.opacities.topk(6).values
    assert_equal(two_steps.sort(descending=True).values, most_opaque, atol=0.06)


def test_harmonics_are_refined_and_features_kept(scene):
    """New Gaussians start with none of both, copies with those of their parents."""
    marks = torch.arange(1.0, 31)[None, :, None]
    start = cloud(30).replace(sh=torch.zeros(1, 30, 8, 3), features=marks)
    result = refine(start, scene[0], 60, count=50).gaussians
    assert result.sh.shape == (1, 50, 8, 3)
    assert result.sh.abs().max() > 1e-3
    assert {*result.features.flatten().tolist()} <= {*range(31)}
    assert (result.features == start.most_opaque(15).features[0, 0, 0]).any()


def test_an_interrupt_keeps_what_there_is(scene, clock):
    clock(lambda now: os.kill(os.getpid(), signal.SIGINT) if now == 11 else None)
    result = refine(cloud(30), scene[0], 1000)
    assert result.stopped_by == "SIGINT"
    assert result.steps == 6  # that of the twelfth reading is finished
    assert result.gaussians.count == 30


def test_a_coarser_level_shows_the_same_scene():
    fine = photos(3, 64, 20)
    masks = fine.images[:, :, :1]
    given = fine.replace(masks=masks, times=torch.rand(1, 3), target_time=torch.rand(1, 1))
    coarse = shrunk(given, 2)
    assert coarse.images.shape[-2:] == (32, 32)
    assert_equal(coarse.masks, coarse.images[:, :, :1])
    assert coarse.times is given.times
    assert coarse.target_time is given.target_time
    assert mean_psnr(cloud(20), coarse) > 32


def test_unusable_input_is_refused():
    views = photos(2)
    four = cloud(4)
    usable = {"gaussians": four, "views": views, "seconds": 1, "count": 4}
    for word, wrong in (
        ("2 scenes", {"gaussians": map_tensors(lambda x: x.expand(2, *x.shape[1:]), four)}),
        ("NaN or infinite", {"gaussians": map_tensors(lambda x: x * math.nan, four)}),
        ("0 photos", {"views": views.select([])}),
        ("0 seconds", {"seconds": 0}),
        ("count=0", {"count": 0}),
    ):
        must_refuse(word, partial(refine, **(usable | wrong)))


def test_colors_may_have_any_value():
    colors = torch.linspace(-0.7, 1.6, 60).reshape(1, 20, 3)
    given = free(cloud(20).replace(colors=colors))
    given.grow(24, generator())
    grown = given.gaussians().colors.clone()
    assert_equal(grown.unique(dim=1), colors)
    whole = torch.cat([given.values["means"], grown[0]], 1).tolist()
    assert all(row in whole for row in torch.cat([cloud(20).means, colors], 2)[0].tolist())
    grown.sum().backward()
    given.optimizer.step()
    assert (given.gaussians().colors < grown).all()


def test_colors_move_into_the_range_of_files():
    """Though photos are white."""
    hidden = {"colors": torch.full((1, 60, 3), 1.5), "opacities": torch.full((1, 60), 1e-3)}
    given = cloud(60).replace(**hidden)
    white = photos(3)
    white = white.replace(images=torch.ones_like(white.images))
    assert refine(given, white, 30, swept=0.0).gaussians.colors.max() < 1.45


def test_growth_leaves_the_rendering_as_it_is():
    """Also of fog, Gaussians that are all faint, of which many copies are made at once.

    Neighbours in space are neighbours in memory then.
    """
    fog = 0.01 + 0.05 * torch.rand(1, 200)
    given = free(cloud(200).replace(opacities=fog))
    before = shots(given.gaussians(), range(0, 91, 15), 24, RENDERER)
    given.grow(400, generator())
    assert mean_psnr(given.gaussians(), before) > 35
    means = given.values["means"]
    assert means.diff(dim=0).norm(dim=1).mean() < torch.pdist(means).mean() / 2


def refined(views, seconds, start=None, **extras):
    """The true cloud or another one, refined on views that are not quite true."""
    return refine(start or cloud(60), views, seconds, swept=0.0, extras=Extras(**extras))


def test_a_photo_with_a_wrong_pose_is_met_and_the_others_stay():
    """A small shift looks like a turn, so what the corrected camera sees is compared."""
    true = photos(5)
    wrong = true.cameras.c2w.clone()
    wrong[0, 2, :3, 3] += 0.04 * wrong[0, 2, :3, 0]  # a fiftieth of the distance

    def posed(c2w):
        return true.replace(cameras=true.cameras.replace(c2w=c2w))

    def found(seconds, *adjust):
        return refined(posed(wrong), seconds, adjust=adjust).cameras.c2w

    assert_equal(found(3), wrong)
    better = found(200, "poses")
    before, after = (mean_psnr(cloud(60), posed(c2w).select([2])) for c2w in (wrong, better))
    assert after > before + 3
    assert 0 < (better - wrong)[0, [0, 1, 3, 4], :3, 3].norm(dim=-1).max() < 0.01
    assert_rigid(better)


def test_exposures_of_photos_have_the_mean_0():
    rgb = torch.rand(1, 1, 3, 9, 9)
    adjustments = Adjustments(3, ("exposure",), 1.0, rgb)
    for _ in range(40):
        seen = [adjustments.seen(i, rgb, gain * rgb) for i, gain in enumerate((1.0, 0.4, 1.0))]
    expected = torch.cat([gain * rgb for gain in (1.2, 0.6, 1.2)])
    assert_close(torch.cat(seen), expected, atol=0.02, rtol=0.02)


def test_exposures_of_photos_leave_the_mean_to_the_gaussians():
    """A black background is as bright in all photos."""
    cameras = photos(3).cameras
    gains = torch.tensor([1.0, 0.6, 1])
    true = VIEWER(cloud(60), cameras).rgb
    dark = Views(true * gains[:, None, None, None], cameras)

    def error(*adjust):
        extras = Extras(adjust=adjust)
        found = refine(cloud(60), dark, 150, swept=0.0, renderer=VIEWER, extras=extras)
        with torch.no_grad():
            return (VIEWER(found.gaussians, cameras).rgb - gains.mean() * true).norm()

    assert error("exposure") < 0.8 * error()


def test_harmonics_are_added_unless_the_start_has_some():
    given = cloud(30).replace(sh=torch.zeros(1, 30, 3, 3))
    for start, number in ((given, 3), (cloud(30), 8)):
        assert refined(photos(2), 5, start, degree=2).gaussians.sh.shape[2] == number


def test_values_since_the_last_growth_are_averaged():
    given = free(cloud(20))
    given.average()
    given.grow(24, generator())
    means = given.values["means"]
    grown = means.detach().clone()
    for step in (1.0, 1.0, 4.0):
        means.data += step
        given.average()
    given.settle()
    assert_close(means, grown + 3)


def test_what_masks_leave_out_is_black():
    views = photos(2)
    masks = torch.zeros(1, 2, 1, 24, 24)
    masks[..., :12] = 1
    found = masked(views.replace(masks=masks)).images
    assert_equal(found[..., :12], views.images[..., :12])
    assert not found[..., 12:].any()
    must_refuse("--masks", masked, views)


def test_surroundings_hide_what_is_behind_them():
    views = photos(2)
    color = edge_color(views)
    coloured = cloud(60).replace(sh=0.3 * torch.randn(1, 60, 3, 3))
    found = surrounded(coloured, views, color)
    assert_equal(found.means[:, -60:], cloud(60).means)
    render = AutoRenderer(AutoRenderer.Config(far=1e4))
    black, white = (render(found, views.cameras, torch.full((3,), level)) for level in (0.0, 1.0))
    assert black.alpha.min() > 0.99
    assert_equal(black.rgb, white.rgb, atol=0.01)
    empty = surrounded(cloud(60).replace(opacities=torch.zeros(1, 60)), views, color)
    seen = render(empty, views.cameras, torch.zeros(3))
    assert_equal(seen.rgb[0, 0, :, 12, 12], torch.tensor(color), atol=0.01)


def walked(count):
    """The first photos (1, V) of a walk."""
    return photos_of(walk(20)[:count])


def test_points_lie_on_the_walls_in_their_colours():
    """Of two photos and of more; with sizes far from the truth, and more than one batch."""
    for several, size, number in ((2, 1.0, 400), (2, 2.0, 2400), (9, 4.0, 400)):
        views = walked(several)
        found = swept(views, number, size, generator())
        assert found.count == number
        off = (found.means.abs() / torch.tensor([1.2, 1.0, 1.5])).amax(-1) - 1
        assert (off.abs() < 0.075).float().mean() > 0.85  # depths are tried in steps of 7 %
        seen = to_camera(found.means, views.cameras)
        pixels = to_pixels(seen, views.cameras.intrinsics)[0]
        # each is as large as two pixels of the photo that it is of, and has its colour
        sizes = 2 * seen[0, ..., 2] / INTRINSICS[0]
        difference, photo = (sizes - found.scales[0, :, 0]).abs().min(0)
        assert difference.max() < 1e-5
        x, y = pixels[photo, torch.arange(number)].long().T
        alike = (views.images[0, photo, :, y, x] == found.colors[0]).all(-1)
        assert alike.float().mean() > 0.95  # but for those of two photos as far away


def test_without_evidence_the_depth_is_the_size():
    """Of photos that show nothing in common."""
    views = walked(2)
    views.cameras.c2w[0, 1, :3, [0, 2]] *= -1  # turned about
    found = swept(views, 50, 3.0, generator())
    depths = to_camera(found.means, views.cameras)[0, ..., 2].amax(0)  # from the one that shows it
    assert (depths / 3 - 1).abs().max() < 0.04  # half of a step between the depths that are tried

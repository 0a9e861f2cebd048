"""Evidence of photos on Gaussians: errors to expect, floaters, and a measured distance."""

import math
from dataclasses import replace

import pytest
import torch
from qgs_photos.refine.evidence import errors_of, evidence, quality
from qgs_photos.refine.metric import Point, located
from qgs_photos.viewing import VIEWER
from tables import assert_equal
from walk import arc, cloud, pinhole

from qgs.containers import concatenated
from qgs.geometry.transforms import moved
from qgs.types import Gaussians, Views


def shots(gaussians, degrees, side=48, renderer=VIEWER):
    """Photos (1, V) of Gaussians from a circle of radius 2."""
    cameras = pinhole(arc(degrees, 2).float(), size=(side, side))[None]
    return Views(renderer(gaussians, cameras).rgb.clamp(0, 1), cameras)


def ball(place=(0.0, 0.0, 0.0), size=0.2):
    """A grey opaque Gaussian (1, 1)."""
    quats = torch.tensor([[[1.0, 0, 0, 0]]])
    grey = torch.full((1, 1, 3), 0.5)
    return Gaussians(
        torch.tensor([[place]]), torch.full((1, 1, 3), size), quats, grey[..., 0], grey
    )


def test_floaters_go_if_held_out_photos_do_not_show_them():
    given = cloud(60)
    whole = shots(given, range(0, 90, 15))
    held_out = shots(given, [5.0, 50.0])
    # 0.4 in front of the first camera, on the side of the next
    near = moved(ball((0.1, 0.0, 0.4), 0.02), whole.cameras.c2w[0, 0], 1.0)
    both = concatenated([near, given], 1)
    found = evidence(both, whole)
    cleaned = found.cleaned(held_out)
    assert torch.equal(cleaned.gaussians.means, given.means)
    assert quality(cleaned.gaussians, held_out) > quality(both, held_out)
    for kept in (
        # surroundings, which come first, stay, and so does what photos do show
        evidence(both, whole, 1).cleaned(held_out),
        evidence(both, shots(both, range(0, 90, 15))).cleaned(shots(both, [5.0, 50.0])),
        # nor do four photos of them tell, or none that is held out
        evidence(both, whole.select([0, 1, 2, 3])).cleaned(held_out),
        found.cleaned(held_out.select([])),
    ):
        assert kept.gaussians.count == 61


def center(found, degree):
    camera = shots(found.gaussians, [degree]).cameras
    return float(found.error_map(camera)[24, 24])


def test_errors_fall_with_photos_and_grow_with_the_angle():
    wrong = ball().replace(colors=torch.zeros(1, 1, 3), opacities=torch.ones(1, 1))
    two, eight = (
        evidence(wrong, shots(wrong.replace(colors=wrong.colors + 0.1), range(count)))
        for count in (2, 8)
    )
    assert center(two, 0.0) / center(eight, 0.0) == pytest.approx(math.sqrt(9 / 3), rel=0.02)
    assert center(two, 31.0) / center(two, 1.0) == pytest.approx(math.exp(math.pi / 12), rel=0.02)
    away = replace(two.gaussians, means=two.gaussians.means + 100)
    nowhere = replace(two, gaussians=away).error_map(shots(away, [0]).cameras)
    torch.testing.assert_close(nowhere, two.empty.expand(48, 48))
    # photos show that it is empty there
    assert 0 < two.empty < 0.01


def test_errors_are_larger_where_photos_differ_and_as_large_as_held_out_ones():
    given = cloud(60)
    left = given.means[..., :1] < 0
    wrong = given.replace(colors=given.colors + 0.3 * left)
    found = evidence(wrong, shots(given, range(0, 90, 10)))
    left = left[0, :, 0]
    assert found.errors[left].mean() > 1.5 * found.errors[~left].mean()
    judged = shots(given, range(5, 90, 10))
    truth = errors_of(VIEWER(wrong, judged.cameras).rgb, judged.images)[0]
    found = found.calibrated(judged)
    maps = [found.error_map(judged.cameras[:, [view]]) for view in range(9)]
    assert torch.stack(maps).mean() == pytest.approx(float(truth.mean()), rel=0.1)


def test_a_point_of_a_photo_lies_on_the_surface_there():
    """Below the middle of the photo, before what is far behind it; and the camera itself."""
    scales = torch.tensor([[[0.5, 0.5, 1e-3]]])
    wide = ball().replace(scales=scales, opacities=torch.ones(1, 1))
    cameras = shots(wide, [0.0, 90.0]).cameras
    found = located(Point(0, (0.5, 0.75)), wide, cameras)
    axis = cameras.c2w[0, 0, :3, 1]
    assert_equal(found, 0.5 * axis, atol=0.03)
    assert torch.equal(located(Point(1, None), wide, cameras), cameras.c2w[0, 1, :3, 3])
    assert located(Point(0, (0.0, 0.0)), ball(), cameras).isnan().all()

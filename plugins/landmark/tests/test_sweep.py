"""The sweep over depths: photos of a wall that are known in closed form, and sample by sample."""

import pytest
import torch
import torch.nn.functional as F
from qgs_landmark.observed import ObservedQueries
from qgs_landmark.places import cells, patch_centres
from qgs_landmark.sweep import mismatch
from qgs_locus.fields import CENTER
from torch.testing import assert_close

from qgs.contracts import ModelDims
from qgs.geometry.rays import camera_rays
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.types import Cameras, ImageMemory, Views

SIZE, WALL = (24, 32), 1.5
"""H x W; depth of the wall z = WALL, that the first camera looks at."""
PIXELS = torch.tensor([32.0, 24.0], dtype=torch.float64)
DEPTHS = torch.tensor([0.8, 1.1, WALL, 2.0, 3.0], dtype=torch.float64)
FIRST = torch.zeros(1, dtype=torch.long)


def photos(count=2):
    """A wall with waves of colour, seen by cameras that are moved to the right and turned."""
    turn = torch.arange(count, dtype=torch.float64) * -0.08
    c2w = torch.eye(4, dtype=torch.float64).repeat(1, count, 1, 1)
    c2w[..., 0, 0] = c2w[..., 2, 2] = turn.cos()
    c2w[..., 0, 2], c2w[..., 2, 0] = turn.sin(), -turn.sin()
    c2w[0, :, 0, 3] = 0.2 * torch.arange(count)
    lens = torch.tensor([30.0, 30.0, 16.0, 12.0], dtype=torch.float64).expand(1, count, 4)
    cameras = Cameras(c2w, lens, SIZE)
    origin, direction = camera_rays(cameras)
    far = (WALL - origin[..., 2:]) / direction[..., 2:]
    x, y, _ = (origin + far * direction).unbind(-1)
    waves = torch.stack([9 * x + 3 * y, 8 * y - 5 * x, 11 * x], 2).sin()
    return Views(0.5 + 0.4 * waves, cameras)


@pytest.mark.parametrize("count", [2, 3])
def test_photos_agree_at_the_depth_of_the_wall(count):
    """Places in the middle of a photo, which other cameras see at all depths."""
    place = 0.35 + 0.3 * patch_centres(2, 3, torch.device("cpu")).double()[None]
    error, seen = mismatch(photos(count), FIRST.expand(6), place, DEPTHS, 6.0, 4)
    assert seen.all()
    assert (error.argmin(-1) == 2).all()
    assert error[..., 2].max() < 0.03  # bilinear colours between pixels
    assert error[..., [0, 4]].min() > 0.1


def test_differences_are_those_of_each_sample_alone():
    given, place = photos(), torch.tensor([[[0.5, 0.4], [0.3, 0.6]]], dtype=torch.float64)
    error, _ = mismatch(given, torch.tensor([0, 1]), place, DEPTHS, 5.0, 3)

    def colours(view, pixels):
        grid = (2 * pixels / PIXELS - 1).view(1, 1, -1, 2)
        return F.grid_sample(given.images[:, view], grid, align_corners=False)[0, :, 0]

    for view, other in ((0, 1), (1, 0)):
        pixels = place[0, view] * PIXELS + 5.0 * cells(9, 3, place)
        slope = F.pad((pixels - torch.tensor([16.0, 12.0])) / 30, (0, 1), value=1.0)
        c2w, camera = given.cameras.c2w[0, view], given.cameras[:, other : other + 1]
        world = DEPTHS[:, None, None] * slope @ c2w[:3, :3].mT + c2w[:3, 3]
        there = to_pixels(to_camera(world.flatten(0, 1)[None], camera), camera.intrinsics)
        apart = colours(other, there).unflatten(-1, (5, 9)) - colours(view, pixels)[:, None]
        assert_close(error[0, view], apart.abs().mean((0, 2)))


def test_depths_that_no_other_photo_sees_do_not_count():
    corner = torch.tensor([[[0.02, 0.5]]], dtype=torch.float64)  # the second camera stands right
    error, seen = mismatch(photos(), FIRST, corner, DEPTHS[:2] / 2, 2.0, 2)
    assert not seen.any()
    assert not error.any()
    assert not mismatch(photos(1), FIRST, corner, DEPTHS, 2.0, 2)[1].any()


def test_anchors_start_where_the_photos_agree():
    config = ObservedQueries.Config(count=None, near=0.5, far=4.5, sweep=25)
    queries = ObservedQueries(config, ModelDims(width=8, heads=2, depth=1)).double().eval()
    state = queries(ImageMemory(torch.randn(1, 96, 8).double(), grid=(2, 6, 8)), photos())
    depth = state[CENTER][0, :48, 2].view(6, 8)[1:-1, 2:-2]
    assert_close(depth, torch.full_like(depth, WALL), rtol=0.05, atol=0.0)

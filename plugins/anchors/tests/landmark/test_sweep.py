"""The sweep over depths: photos of a wall that are known in closed form, and sample by sample."""

import torch
from qgs_anchors.landmark.observed import ObservedQueries
from qgs_anchors.landmark.places import cells
from qgs_anchors.landmark.sweep import mismatch
from qgs_locus.fields import CENTER
from small_parts import made
from torch.testing import assert_close

from qgs.geometry.rays import camera_rays
from qgs.types import Cameras, ImageMemory, Views

SIZE = (24, 32)
WALL = 1.5
"""H x W; depth of the wall z = WALL, that the first camera looks at."""
DEPTHS = torch.tensor([0.8, 1.1, WALL, 2.0, 3.0]).double()
FIRST = torch.zeros(1, dtype=torch.long)


def photos(count=2):
    """A wall with waves of colour, seen by cameras that are moved to the right and turned."""
    number = torch.arange(count).double()
    skew = torch.tensor([[0, 0, -0.08, 0], [0] * 4, [0.08, 0, 0, 0], [0] * 4]).double()
    c2w = torch.linalg.matrix_exp(number[:, None, None] * skew)
    c2w[:, 0, 3] = 0.2 * number
    lens = torch.tensor([30.0, 30.0, 16.0, 12.0]).double().expand(1, count, 4)
    cameras = Cameras(c2w[None], lens, SIZE)
    origin, direction = camera_rays(cameras)
    far = (WALL - origin[..., 2:]) / direction[..., 2:]
    x, y, _ = (origin + far * direction).unbind(-1)
    waves = torch.stack([9 * x + 3 * y, 8 * y - 5 * x, 11 * x], 2).sin()
    return Views(0.5 + 0.4 * waves, cameras)


def test_differences_are_those_of_each_sample_alone():
    """Of ramps that cameras side by side see, by the number of pixels that depths shift them."""
    c2w = torch.eye(4).double().repeat(1, 2, 1, 1)
    c2w[0, 1, 0, 3] = 0.2
    ramps = torch.tensor([0.01, 0.02])[:, None, None, None] * (torch.arange(32) + 0.5)
    images = ramps.double().expand(1, 2, 3, *SIZE)
    given = Views(images, photos().cameras.replace(c2w=c2w))
    place = torch.full((1, 2, 2), 0.5).double()
    error, _ = mismatch(given, torch.tensor([0, 1]), place, DEPTHS, 5.0, 3)
    at = 16 + 5 * cells(9, 3, place)[:, 0]
    shift = 30 * 0.2 / DEPTHS[:, None]
    apart = torch.stack([0.02 * (at - shift) - 0.01 * at, 0.01 * (at + shift) - 0.02 * at])
    assert_close(error[0], apart.abs().mean(-1))


def test_depths_that_no_other_photo_sees_do_not_count():
    corner = torch.tensor([[[0.02, 0.5]]]).double()  # the second camera stands right
    error, seen = mismatch(photos(), FIRST, corner, DEPTHS[:2] / 2, 2.0, 2)
    assert not seen.any()
    assert not error.any()
    assert not mismatch(photos(1), FIRST, corner, DEPTHS, 2.0, 2)[1].any()


def test_anchors_start_where_the_photos_agree():
    queries = made(ObservedQueries, count=None, near=0.5, far=4.5, sweep=25).double().eval()
    state = queries(ImageMemory(torch.randn(1, 96, 16).double(), grid=(2, 6, 8)), photos())
    depth = state[CENTER][0, :48, 2].view(6, 8)[1:-1, 2:-2]
    assert_close(depth, torch.full_like(depth, WALL), rtol=0.05, atol=0.0)

"""The sweep over depths: photos of a wall that are known in closed form, and sample by sample."""

import math

import pytest
import torch
from qgs_landmark.observed import ObservedQueries
from qgs_landmark.places import cells, patch_centres
from qgs_landmark.sweep import mismatch
from qgs_locus.fields import CENTER
from torch import Tensor

from qgs.contracts import ModelDims
from qgs.geometry.rays import camera_rays
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.types import Cameras, ImageMemory, Views

SIZE, WALL = (24, 32), 1.5
"""H x W; depth of the wall z = WALL, that the first camera looks at."""
DEPTHS = torch.tensor([0.8, 1.1, WALL, 2.0, 3.0], dtype=torch.float64)


def photos(count: int = 2) -> Views:
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
    waves = [torch.sin(9 * x + 3 * y), torch.sin(8 * y - 5 * x), torch.sin(11 * x) * y.cos()]
    return Views(0.5 + 0.4 * torch.stack(waves, 2), cameras)


def middle_places() -> Tensor:
    """Places (1, 6, 2) in the middle of a photo, which other cameras see at all depths."""
    return 0.35 + 0.3 * patch_centres(2, 3, torch.device("cpu")).double()[None]


@pytest.mark.parametrize("count", [2, 3])
def test_photos_agree_at_the_depth_of_the_wall(count: int) -> None:
    view_N = torch.zeros(6, dtype=torch.long)
    error, seen = mismatch(photos(count), view_N, middle_places(), DEPTHS, 6.0, 4)
    assert seen.all()
    assert (error.argmin(-1) == 2).all()
    assert error[..., 2].max() < 0.03  # bilinear colours between pixels
    assert error[..., [0, 4]].min() > 0.1


def test_differences_are_those_of_each_sample_alone() -> None:
    given, place = photos(), torch.tensor([[[0.5, 0.4], [0.3, 0.6]]], dtype=torch.float64)
    cameras, side, points = given.cameras, 5.0, 3
    error, _ = mismatch(given, torch.tensor([0, 1]), place, DEPTHS, side, points)
    for anchor, (view, other) in enumerate([(0, 1), (1, 0)]):
        pixels = place[0, anchor] * torch.tensor([32.0, 24.0]) + side * cells(
            points**2, points, place
        )
        slope = (pixels - torch.tensor([16.0, 12.0])) / 30
        for index, depth in enumerate(DEPTHS):
            local = depth * torch.cat([slope, torch.ones(len(slope), 1)], -1)
            world = local @ cameras.c2w[0, view, :3, :3].mT + cameras.c2w[0, view, :3, 3]
            camera = cameras[:, other : other + 1]
            there = to_pixels(to_camera(world[None], camera), camera.intrinsics)[0, 0]
            expected = [
                (colour(given, other, *p) - colour(given, view, *q)).abs().mean()
                for p, q in zip(there.tolist(), pixels.tolist(), strict=True)
            ]
            torch.testing.assert_close(error[0, anchor, index], torch.stack(expected).mean())


def colour(given: Views, view: int, x: float, y: float) -> Tensor:
    """RGB between the four pixels around (x, y)."""
    left, top = math.floor(x - 0.5), math.floor(y - 0.5)
    right, below = x - 0.5 - left, y - 0.5 - top
    square = given.images[0, view, :, top : top + 2, left : left + 2]
    shares = torch.tensor([1 - below, below])[:, None] * torch.tensor([1 - right, right])
    return (square * shares).sum((-1, -2))


def test_depths_that_no_other_photo_sees_do_not_count() -> None:
    corner = torch.tensor([[[0.02, 0.5]]], dtype=torch.float64)  # the second camera stands right
    error, seen = mismatch(photos(), torch.tensor([0]), corner, DEPTHS[:2] / 2, 2.0, 2)
    assert not seen.any()
    assert torch.equal(error, torch.zeros_like(error))
    single = mismatch(photos(1), torch.tensor([0]), corner, DEPTHS, 2.0, 2)[1]
    assert not single.any()


def test_anchors_start_where_the_photos_agree() -> None:
    given, dims = photos(), ModelDims(width=8, heads=2, depth=1)
    config = ObservedQueries.Config(count=None, near=0.5, far=4.5, sweep=25)
    queries = ObservedQueries(config, dims).double().eval()
    state = queries(ImageMemory(torch.randn(1, 96, 8).double(), grid=(2, 6, 8)), given)
    depth = state[CENTER][0, :48, 2].view(6, 8)[1:-1, 2:-2]
    torch.testing.assert_close(depth, torch.full_like(depth, WALL), rtol=0.05, atol=0.0)

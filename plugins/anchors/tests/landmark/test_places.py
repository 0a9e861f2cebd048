"""Places in photos against loops over pixels; the sweep over depths, sample by sample."""

from itertools import product

import torch
import torch.nn.functional as F
import yaml
from qgs_anchors.landmark.observed import ObservedQueries
from qgs_anchors.landmark.places import cells, colors_at, sampled, spread
from qgs_anchors.landmark.sweep import mismatch
from qgs_locus.fields import CENTER
from small_parts import made
from tables import assert_near
from torch.testing import assert_close
from walk import along_x, arc, pinhole

from qgs.geometry.rays import camera_rays, pixel_directions
from qgs.types import ImageMemory, Views

GRID = (3, 4, 6)
"""Views, rows, columns."""
CPU = torch.device("cpu")


def patch_centres(rows, columns):
    """Return places (rows * columns, 2) of the centres of a photo's patches, row by row."""
    lens = torch.tensor([columns, rows, 0.0, 0.0])
    return pixel_directions(lens, (rows, columns))[..., :2].flatten(0, 1)


def test_bilinear_features_are_those_of_torch():
    maps = torch.randn(2, 72, 5).double()
    place = torch.rand(50, 2).double()
    view = torch.randint(3, (50,))
    images = maps.unflatten(1, GRID)[:, view].movedim(-1, 2).flatten(0, 1)
    at = 2 * place.repeat(2, 1)[:, None, None] - 1
    expected = F.grid_sample(images, at, padding_mode="border", align_corners=False)
    assert_close(sampled(maps, GRID, view, place), expected.view(2, 50, 5))


def test_points_are_spread_evenly_over_all_photos():
    size = torch.tensor([64.0, 48.0])
    pixels = patch_centres(48, 64) * size
    for views, count in product((1, 2, 5), (1, 256, 300)):
        view_N, place, _ = spread(count, views, (48, 64), 1.0, CPU)
        numbers = view_N.bincount(minlength=views)
        assert numbers.max() - numbers.min() <= 1
        for view in range(views) if count > 1 else ():
            own = place[view_N == view] * size
            area = 48 * 64 / len(own)
            nearest, owner = torch.cdist(pixels, own).min(1)
            assert nearest.max() < 0.9 * area**0.5  # half a diagonal of a part is .71 of its side
            held = owner.bincount(minlength=len(own)) / area
            assert 0.5 < held.min() <= held.max() < 1.6


TILES = """
- [256, 2, 64, 64, 0.5, 16, 8]
- [256, 8, 64, 64, 0.5, 8, 4]
- [512, 2, 64, 64, 1, 16, 16]
- [64, 1, 128, 64, 0.5, 16, 4]
- [64, 1, 64, 128, 0.5, 8, 8]
- [48, 1, 24, 32, 1, 6, 8]
- [24, 2, 64, 64, 1, 4, 3]
- [128, 2, 128, 64, 1]
- [24, 2, 64, 128, 1]
- [512, 4, 64, 64, 1]
- [26, 2, 64, 64, 1]
- [255, 2, 64, 64, 1]
- [2, 5, 64, 64, 1]
"""
"""Points, photos, their height and width, aspect; rows and columns, but not of points in rows."""


def test_points_are_in_tiles_where_these_divide_the_photos():
    for count, views, height, width, aspect, *grid in yaml.safe_load(TILES):
        view, place, share = spread(count, views, (height, width), aspect, CPU)
        wide, high = (share * torch.tensor([width, height])).tolist()
        assert_near(wide * high * count, views * height * width, rtol=1e-5)
        if grid:
            assert_near([height / high, width / wide], grid, rtol=1e-5)
            for of in range(views):
                assert_close(place[view == of], patch_centres(*grid))
        else:
            assert_near(wide, high, rtol=1e-5)


def within(pixels, at, side):
    """How much of each column or row lies within a square about `at`."""
    first = torch.arange(pixels).double()
    return ((first + 1).clamp(max=at + side / 2) - first.clamp(min=at - side / 2)).clamp(min=0)


def test_colours_are_means_of_squares():
    images = torch.rand(2, 3, 3, 16, 24).double()
    for x, y, side in ((15, 7, 2), (23, 15, 2), (1, 1, 2), (8.4, 8, 3), (14.7, 6.4, 3)):
        place = torch.tensor([[[x / 24, y / 16]]] * 3).double()
        found = colors_at(images, side, torch.arange(3), place).squeeze(2)
        shares = within(16, y, side)[:, None] * within(24, x, side) / side**2
        assert_close(found, (images * shares).sum((-1, -2)), rtol=0, atol=1e-6)


WALL_SIZE = (24, 32)
WALL = 1.5
"""H x W; depth of the wall z = 0, that the first camera looks at."""
DEPTHS = torch.tensor([0.8, 1.1, WALL, 2.0, 3.0]).double()
FIRST = torch.zeros(1).long()


def photos(count=2):
    """A wall with waves of colour, seen by cameras that are moved to the right and turned."""
    c2w = arc(-8 * torch.arange(count), WALL)
    cameras = pinhole(c2w, (30.0, 30.0, 16.0, 12.0), WALL_SIZE)[None]
    origin, direction = camera_rays(cameras)
    far = -origin[..., 2:] / direction[..., 2:]
    x, y, _ = (origin + far * direction).unbind(-1)
    waves = torch.stack([9 * x + 3 * y, 8 * y - 5 * x, 11 * x], 2).sin()
    return Views(0.5 + 0.4 * waves, cameras)


def test_differences_are_those_of_each_sample_alone():
    """Of ramps that cameras side by side see, by the number of pixels that depths shift them."""
    c2w = along_x([0.0, 0.2]).double()[None]
    ramps = torch.tensor([0.01, 0.02])[:, None, None, None] * (torch.arange(32) + 0.5)
    given = Views(ramps.double().expand(1, 2, 3, *WALL_SIZE), photos().cameras.replace(c2w=c2w))
    place = torch.full((2, 2), 0.5).double()
    error, _ = mismatch(given, torch.tensor([0, 1]), place, DEPTHS, 5.0, 3)
    at = 16 + 5 * cells(9, 3, place)[:, 0]
    shift = 30 * 0.2 / DEPTHS[:, None]
    apart = torch.stack([0.02 * (at - shift) - 0.01 * at, 0.01 * (at + shift) - 0.02 * at])
    assert_close(error[0], apart.abs().mean(-1))


def test_depths_that_no_other_photo_sees_do_not_count():
    corner = torch.tensor([[0.02, 0.5]]).double()  # the second camera stands right
    error, seen = mismatch(photos(), FIRST, corner, DEPTHS[:2] / 2, 2.0, 2)
    assert not seen.any()
    assert not error.any()
    assert not mismatch(photos(1), FIRST, corner, DEPTHS, 2.0, 2)[1].any()


def test_anchors_start_where_the_photos_agree():
    queries = made(ObservedQueries, count=None, near=0.5, far=4.5, sweep=25).double().eval()
    state = queries(ImageMemory(torch.randn(1, 96, 16).double(), grid=(2, 6, 8)), photos())
    depth = WALL + state[CENTER][0, :48, 2].view(6, 8)[1:-1, 2:-2]
    assert_close(depth, torch.full_like(depth, WALL), rtol=0.05, atol=0.0)

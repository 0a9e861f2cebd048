"""Places in photos against loops over pixels, and against torch's own sampling."""

import math

import pytest
import torch
import torch.nn.functional as F
from qgs_landmark.places import cells, colors_at, patch_centres, rays_at, sampled, spread
from torch import Tensor

from qgs.geometry.rays import camera_rays
from qgs.types import Cameras

GRID = (3, 4, 6)
"""Views, rows, columns."""
SIZE = (16, 24)


def cameras(scenes: int = 2) -> Cameras:
    """Turned by some angle about y and moved, with unequal focal lengths, off centre."""
    turn = torch.linspace(-0.5, 0.4, scenes * GRID[0], dtype=torch.float64).view(scenes, -1)
    c2w = torch.eye(4, dtype=torch.float64).repeat(scenes, GRID[0], 1, 1)
    c2w[..., 0, 0] = c2w[..., 2, 2] = turn.cos()
    c2w[..., 0, 2], c2w[..., 2, 0] = turn.sin(), -turn.sin()
    generator = torch.Generator().manual_seed(0)
    c2w[..., :3, 3] = torch.randn(scenes, GRID[0], 3, generator=generator, dtype=torch.float64)
    lens = torch.tensor([19.0, 21.0, 11.5, 8.5], dtype=torch.float64).expand(scenes, GRID[0], 4)
    return Cameras(c2w, lens, SIZE)


def places(count: int) -> tuple[Tensor, Tensor]:
    """Drawn views (N,) and places (2, N, 2)."""
    generator = torch.Generator().manual_seed(1)
    views = torch.randint(GRID[0], (count,), generator=generator)
    return views, torch.rand(2, count, 2, generator=generator, dtype=torch.float64)


def test_bilinear_features_are_those_of_torch() -> None:
    view_N, place_BN2 = places(50)
    maps = torch.randn(2, math.prod(GRID), 5, dtype=torch.float64)
    found = sampled(maps, GRID, view_N, place_BN2)
    for scene in range(2):
        for index, view in enumerate(view_N.tolist()):
            image = maps[scene].unflatten(0, GRID)[view].movedim(-1, 0)[None]
            at = 2 * place_BN2[scene, index].view(1, 1, 1, 2) - 1
            one = F.grid_sample(image, at, padding_mode="border", align_corners=False)
            torch.testing.assert_close(found[scene, index], one[0, :, 0, 0])


def test_at_the_centre_of_a_patch_there_is_its_token_alone() -> None:
    maps = torch.randn(2, math.prod(GRID), 5)
    place = patch_centres(*GRID[1:], torch.device("cpu")).repeat(GRID[0], 1).expand(2, -1, -1)
    view_N = torch.arange(GRID[0]).repeat_interleave(GRID[1] * GRID[2])
    torch.testing.assert_close(sampled(maps, GRID, view_N, place), maps)


def test_rays_are_those_of_pixels() -> None:
    given = cameras()
    pixels = patch_centres(*SIZE, torch.device("cpu")).double().expand(2, -1, -1)
    for view in range(GRID[0]):
        views = torch.full((pixels.shape[1],), view)
        origin, direction = rays_at(given, views, pixels)
        expected_origin, expected = (x[:, view].flatten(1, 2) for x in camera_rays(given))
        torch.testing.assert_close(origin, expected_origin)
        torch.testing.assert_close(F.normalize(direction, dim=-1), expected)
        depth = (direction @ given.c2w[:, view, :3, 2, None])[..., 0]
        torch.testing.assert_close(depth, torch.ones_like(depth))


@pytest.mark.parametrize("views", [1, 2, 5])
@pytest.mark.parametrize("count", [1, 256, 300])
def test_points_are_spread_evenly_over_all_photos(views: int, count: int) -> None:
    generator = torch.Generator().manual_seed(0)
    view_N, place = spread(count, torch.rand(1, views, 2, generator=generator))
    assert view_N.bincount(minlength=views).max() - view_N.bincount(minlength=views).min() <= 1
    assert place.min() >= 0
    assert place.max() < 1
    for view in range(views) if count >= 16 * views else ():
        own = place[0, view_N == view]
        in_quarters = (own * 4).long().clamp(0, 3)  # of 4 x 4 parts none has too few or too many
        held = (in_quarters[:, 1] * 4 + in_quarters[:, 0]).bincount(minlength=16)
        assert (held - len(own) / 16).abs().max() <= 4  # of random points 9


def test_points_of_the_first_views_do_not_depend_on_the_numbers_of_scenes() -> None:
    one, several = (spread(20, torch.zeros(scenes, 2, 2))[1] for scenes in (1, 3))
    assert torch.equal(one.expand(3, -1, -1), several)


@pytest.mark.parametrize(
    ("count", "rows", "columns"), [(1, 1, 1), (4, 2, 2), (6, 2, 3), (5, 1, 5), (8, 2, 4)]
)
def test_cells_divide_a_square(count: int, rows: int, columns: int) -> None:
    middles = [
        ((column + 0.5) / columns - 0.5, (row + 0.5) / rows - 0.5)
        for row in range(rows)
        for column in range(columns)
    ]
    torch.testing.assert_close(cells(count, torch.empty(0)), torch.tensor(middles))


def test_colours_are_means_of_squares() -> None:
    images = torch.rand(2, GRID[0], 3, *SIZE, dtype=torch.float64)
    squares = patch_centres(8, 12, torch.device("cpu")).double().expand(2, -1, -1)
    for view in range(GRID[0]):
        found = colors_at(images, 2.0, torch.full((96,), view), squares).unflatten(1, (8, 12))
        for row in range(8):
            for column in range(12):
                square = images[:, view, :, 2 * row : 2 * row + 2, 2 * column : 2 * column + 2]
                torch.testing.assert_close(found[:, row, column], square.mean((-1, -2)))

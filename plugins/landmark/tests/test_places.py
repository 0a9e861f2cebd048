"""Places in photos against loops over pixels, and against torch's own sampling."""

import math

import pytest
import torch
import torch.nn.functional as F
from qgs_landmark.places import (
    aspect_of,
    cells,
    colors_at,
    patch_centres,
    rays_at,
    rows_in_square,
    rows_in_tile,
    sampled,
    spread,
)
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
    view_N, place, _ = spread(count, views, (48, 64), 1.0, torch.device("cpu"))
    assert view_N.bincount(minlength=views).max() - view_N.bincount(minlength=views).min() <= 1
    pixels = (patch_centres(48, 64, place.device) * torch.tensor([64.0, 48.0])).double()
    for view in range(views) if count >= 16 * views else ():
        own = place[view_N == view].double() * torch.tensor([64.0, 48.0])
        area = 48 * 64 / len(own)
        nearest, owner = torch.cdist(pixels, own).min(1)
        assert nearest.max() < 0.9 * area**0.5  # half a diagonal of a part is .71 of its side
        held = owner.bincount(minlength=len(own))
        assert held.min() > 0.5 * area
        assert held.max() < 1.6 * area


def test_as_many_points_as_tokens_are_their_patches() -> None:
    view_N, place, share = spread(48, 1, (24, 32), 1.0, torch.device("cpu"))
    torch.testing.assert_close(place, patch_centres(6, 8, place.device))
    torch.testing.assert_close(share, torch.tensor([1 / 8, 1 / 6]))
    assert not view_N.any()


@pytest.mark.parametrize(
    ("count", "views", "size", "aspect", "grid"),  # rows and columns; none where points are in rows
    [
        (256, 2, (64, 64), 0.5, (16, 8)),
        (256, 8, (64, 64), 0.5, (8, 4)),
        (512, 2, (64, 64), 1.0, (16, 16)),
        (64, 1, (128, 64), 0.5, (16, 4)),
        (64, 1, (64, 128), 0.5, (8, 8)),
        (128, 2, (128, 64), 1.0, None),
        (24, 2, (64, 64), 1.0, (4, 3)),
        (24, 2, (64, 128), 1.0, None),
        (512, 4, (64, 64), 1.0, None),
        (26, 2, (64, 64), 1.0, None),
        (255, 2, (64, 64), 1.0, None),
        (2, 5, (64, 64), 1.0, None),
    ],
)
def test_points_are_in_tiles_where_these_divide_the_photos(
    count: int,
    views: int,
    size: tuple[int, int],
    aspect: float,
    grid: tuple[int, int] | None,
) -> None:
    view, place, share = spread(count, views, size, aspect, torch.device("cpu"))
    wide, high = (share * torch.tensor(size[::-1])).tolist()
    assert wide * high * count == pytest.approx(views * math.prod(size), rel=1e-5)
    if grid is None:
        assert wide == pytest.approx(high, rel=1e-5)
        return
    assert (size[0] / high, size[1] / wide) == pytest.approx(grid, rel=1e-5)
    for of in range(views):
        torch.testing.assert_close(place[view == of], patch_centres(*grid, place.device))


@pytest.mark.parametrize(
    ("count", "in_square", "in_tile", "aspect"),
    [(1, 1, 1, 1), (2, 1, 1, 0.5), (3, 2, 2, 1), (4, 2, 2, 1), (6, 2, 2, 2 / 3), (8, 3, 2, 0.5)],
)
def test_cells_of_tiles_are_squares(
    count: int, in_square: int, in_tile: int, aspect: float
) -> None:
    assert (rows_in_square(count), rows_in_tile(count)) == (in_square, in_tile)
    assert aspect_of(count) == pytest.approx(aspect)


@pytest.mark.parametrize(
    ("count", "rows"), [(1, [1]), (2, [2]), (4, [2, 2]), (6, [3, 3]), (5, [2, 3]), (8, [2, 3, 3])]
)
def test_cells_divide_a_square(count: int, rows: list[int]) -> None:
    middles = [
        ((column + 0.5) / columns - 0.5, (row + 0.5) / len(rows) - 0.5)
        for row, columns in enumerate(rows)
        for column in range(columns)
    ]
    found = cells(count, rows_in_square(count), torch.empty(0))
    torch.testing.assert_close(found, torch.tensor(middles))


def test_colours_are_means_of_squares() -> None:
    images = torch.rand(2, GRID[0], 3, *SIZE, dtype=torch.float64)
    squares = patch_centres(8, 12, torch.device("cpu")).double().expand(2, -1, -1)
    for view in range(GRID[0]):
        found = colors_at(images, 2.0, torch.full((96,), view), squares).unflatten(1, (8, 12))
        for row in range(8):
            for column in range(12):
                square = images[:, view, :, 2 * row : 2 * row + 2, 2 * column : 2 * column + 2]
                torch.testing.assert_close(
                    found[:, row, column], square.mean((-1, -2)), rtol=0, atol=1e-6
                )


def test_colours_are_means_of_squares_that_lie_across_pixels() -> None:
    image = torch.rand(1, 1, 3, *SIZE, generator=torch.Generator().manual_seed(0)).double()
    place = torch.tensor([[[0.35, 0.5], [0.613, 0.4]]], dtype=torch.float64)
    found = colors_at(image, 3.0, torch.zeros(2, dtype=torch.long), place)
    for index, (x, y) in enumerate((place[0] * torch.tensor([SIZE[1], SIZE[0]])).tolist()):
        shares = [  # of each column and row, how much of it lies within
            (torch.arange(n) + 1).clamp(max=at + 1.5) - torch.arange(n).clamp(min=at - 1.5)
            for n, at in ((SIZE[1], x), (SIZE[0], y))
        ]
        column, row = (share.clamp(min=0).double() / 3 for share in shares)
        expected = torch.einsum("chw,h,w->c", image[0, 0], row, column)
        torch.testing.assert_close(found[0, index], expected, rtol=0, atol=1e-6)

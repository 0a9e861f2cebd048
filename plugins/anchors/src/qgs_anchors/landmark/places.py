"""Points of photos: their coordinates, the colours there, and the rays through them.

A point (`place`) is x and y as fractions of a photo's width and height. `view_N` has the index
of the photo of each point.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.constants import constant
from qgs.precision import full_precision
from qgs.types import Cameras, Size

EPS = 1e-4
"""Tolerance of comparisons, in pixels or in logarithms of aspect ratios."""
MOST_OFF = 0.35
"""Largest |log(aspect of a tile / wanted aspect)| at which `spread` uses tiles, not rows.

The value corresponds to a factor of 1.4. With tiles that were off by a factor of 2, PSNR was worse
than with rows: 20.1 against 20.3 dB, for untrained models with 512 points and 4 photos in 32
validation rooms."""


def patches(
    grid: tuple[int, int, int], each: int, size: Size, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """Put `each` points at the centre of every patch of a grid (V, rows, columns).

    The three results mean the same as those of `spread`: the photo of each point, the points, and
    the width and height of the square around each point.
    """
    photos, rows, columns = grid
    count = rows * columns
    index_N = torch.arange(photos * count, device=device).repeat_interleave(each)
    place_N2 = parts(index_N % count, count, rows)
    return index_N // count, place_N2, _square(len(index_N), photos, size, place_N2)


def spread(
    count: int, views: int, size: Size, aspect: float, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """Spread N = `count` points evenly over photos of size (H, W).

    Returns the index of each point's photo (N,), which goes through all photos in turn; the points
    (N, 2); and width and height (2,) of the region of a photo that a point represents. Points,
    width and height are fractions of the photo's width and height.

    The regions are equal tiles if tiles of about `aspect` (height over width in pixels) fill every
    photo; the points are their centres. Otherwise the points are in rows, some of which have one
    point more than others, and the region is a square. Tiles and rows spread points as evenly as a
    low-discrepancy sequence. With fewer points than photos, some photos have no point.
    """
    index_N = torch.arange(count, device=device)
    of_photo = size[0] / size[1]
    view_N = index_N % views
    held_N = (count - 1 - view_N) // views + 1
    # Tensors: torch.compile would make a graph for each number that Python compares.
    each = held_N.amin()
    rows_R = index_N + 1
    off_R = (each * of_photo / rows_R**2 / aspect).log().abs()
    # Tiles must form full rows with equally many columns, the same in every photo.
    fit_R = (each % rows_R == 0) & (off_R < MOST_OFF) & (each * views == count)
    # If two are equally far off, take the wider one.
    wider_R = off_R - EPS * rows_R.log()
    rows = torch.where(fit_R, wider_R, torch.inf).argmin() + 1
    tiled = fit_R.any()
    # Otherwise rows and columns follow the aspect of the photo.
    in_rows_N = torch.minimum((held_N * of_photo).sqrt().round().clamp_min(1).long(), held_N)
    place_N2 = parts(index_N // views, held_N, torch.where(tiled, rows, in_rows_N))
    tile_2 = torch.stack([rows / each, 1 / rows])
    square_2 = _square(count, views, size, place_N2)
    return view_N, place_N2, torch.where(tiled, tile_2, square_2)


def _square(count: int, views: int, size: Size, like: Tensor) -> Tensor:
    """Return the side `side_of` of a square as fractions (2,) of a photo's width and height."""
    return side_of(count, views, size) / constant(size[::-1], like)


def side_of(count: int, views: int, size: Size) -> float:
    """Return the side in pixels of `count` equal squares with the total area of all photos."""
    return math.sqrt(views * math.prod(size) / count)


def rows_in_square(count: int) -> int:
    """Return the number of rows if `count` nearly square cells fill a square."""
    return round(math.sqrt(count))


def rows_in_tile(count: int) -> int:
    """Return the number of rows of a grid with exactly `count` cells that is as square as possible.

    The grid has at least as many columns as rows, and at most twice as many. If no grid has these
    properties, such as for 5 cells, the result is the square root of `count`, rounded.
    """
    few = range(math.isqrt(count), 0, -1)
    grids = (rows for rows in few if count % rows == 0 and count <= 2 * rows**2)
    return next(grids, rows_in_square(count))


def aspect_of(count: int) -> float:
    """Return height / width of a grid of `count` square cells; 1 if `rows_in_tile` has no grid."""
    rows = rows_in_tile(count)
    return rows**2 / count if count % rows == 0 else 1.0


def cells(count: int, rows: int | Tensor, like: Tensor) -> Tensor:
    """Return the centres (K, 2) of K = `count` cells of a unit square around the origin.

    Centres are x and y, row by row, in `rows` rows.
    """
    index_K = torch.arange(count, device=like.device)
    # A tensor: torch.compile would make a graph for each number that Python divides.
    return parts(index_K, (index_K + 1).amax(), rows).to(like) - 0.5


def parts(index_N: Tensor, count: Tensor | int, rows: Tensor | int) -> Tensor:
    """Return the centres (N, 2), x and y from 0 to 1, of the parts `index_N` of a unit square.

    The square has `count` parts in `rows` rows, numbered row by row. Rows have equal heights. The
    numbers of parts in two rows differ by at most one.
    """
    row_N = ((index_N + 1) * rows - 1) // count
    first_N = row_N * count // rows
    held_N = (row_N + 1) * count // rows - first_N
    x_N = (index_N - first_N + 0.5) / held_N
    y_N = (row_N + 0.5) / rows
    return torch.stack([x_N, y_N], -1)


def sampled(
    maps_BMC: Tensor, grid: tuple[int, int, int], view_N: Tensor, place_N2: Tensor
) -> Tensor:
    """Sample patch values at N points of photos, bilinearly between patch centres: (B, N, C).

    Points beyond the outermost centres get the values at the nearest edge. maps: values (B, M, C)
    of the patches of `grid` (V, rows, columns). view: index (N,) of the photo of each point.
    """
    maps_BVChw = maps_BMC.unflatten(1, grid).movedim(-1, 2)
    return bilinear(maps_BVChw, view_N, place_N2[:, None])[..., 0].mT


def bilinear(maps_BVCHW: Tensor, view_N: Tensor, places: Tensor) -> Tensor:
    """Sample the maps of photos bilinearly at N groups of X points, as (B, C, N, X).

    maps: one map for each photo. view: index (N,) of the photo of each group. places: points (N, X,
    2) of all scenes, or (B, N, X, 2), x and y from 0 to 1. Points outside a map get the values at
    its nearest edge.
    """
    _, photos, _, height, width = maps_BVCHW.shape
    # All maps are stacked below each other: places stay half a pixel inside their own map.
    edge_2 = constant([0.5 / width, 0.5 / height], places)
    x_NX, y_NX = places.maximum(edge_2).minimum(1 - edge_2).unbind(-1)
    y_NX = (y_NX + view_N[:, None]) / photos
    column = maps_BVCHW.transpose(1, 2).flatten(2, 3)
    grid = torch.stack([x_NX, y_NX], -1).expand(len(column), *places.shape[-3:])
    # Half precision is too coarse for places, and float64 features keep their precision.
    kind = torch.promote_types(column.dtype, grid.dtype)
    found = F.grid_sample(column.to(kind), 2 * grid.to(kind) - 1, align_corners=False)
    return found.to(column.dtype)


@full_precision
def colors_at(images_BV3HW: Tensor, side: float, view_N: Tensor, place_NK2: Tensor) -> Tensor:
    """Return mean RGB (B, N, K, 3) over squares of `side` pixels around K points of N photos.

    There is one sample per pixel, so the mean is exact if the side is a whole number. Beyond an
    edge of the photo, the pixels of the edge are repeated.
    """
    places_NKP2 = window(place_NK2, images_BV3HW, side, max(1, math.ceil(side - EPS)))
    found_B3NX = bilinear(images_BV3HW, view_N, places_NKP2.flatten(1, 2))
    return found_B3NX.unflatten(-1, places_NKP2.shape[1:3]).mean(-1).movedim(1, -1)


def window(places: Tensor, images_BV3HW: Tensor, side: float, samples: int) -> Tensor:
    """Return P = samples * samples points (..., P, 2) of squares of `side` pixels around points.

    places: points (..., 2).
    """
    height, width = images_BV3HW.shape[-2:]
    places = places.to(images_BV3HW)
    step_P2 = side * cells(samples**2, samples, places) / constant([width, height], places)
    return places[..., None, :] + step_P2


def rays_at(cameras: Cameras, view_N: Tensor, place_NX2: Tensor) -> tuple[Tensor, Tensor]:
    """Return world-frame origins (B, N, 3) and directions (B, N, X, 3) of rays through points.

    There are X points in each of N photos. Directions have z = 1 in the frame of their camera.
    """
    c2w_BN44 = cameras.c2w[:, view_N]
    lens_BN14 = cameras.intrinsics[:, view_N, None]
    pixel_NX2 = place_NX2.to(lens_BN14) * constant(cameras.size[::-1], lens_BN14)
    slope_BNX2 = (pixel_NX2 - lens_BN14[..., 2:]) / lens_BN14[..., :2]
    local_BNX3 = F.pad(slope_BNX2, (0, 1), value=1.0)
    return c2w_BN44[..., :3, 3], torch.einsum("bnij,bnxj->bnxi", c2w_BN44[..., :3, :3], local_BNX3)

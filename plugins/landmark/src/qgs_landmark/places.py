"""Places in photos: where they are, what is seen there, and the rays through them.

A place is x and y as shares of a photo's width and height; `view_N` says of which photo it is.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.constants import constant
from qgs.geometry.precision import full_precision
from qgs.types import Cameras

EPS = 1e-4
"""By how much a number may exceed a whole one, or a half, that it stands for."""


def patch_centres(rows: int, columns: int, device: torch.device) -> Tensor:
    """Places (rows * columns, 2) in one photo, row by row."""
    y, x = ((torch.arange(n, device=device) + 0.5) / n for n in (rows, columns))
    return torch.cartesian_prod(y, x).flip(-1)


def spread(
    count: int, views: int, size: tuple[int, int], device: torch.device
) -> tuple[Tensor, Tensor]:
    """Views (N,) of N = `count` points, in turn, and their places (N, 2) in photos (H, W).

    They are the middles of parts, which leave nothing out: of tiles, see `footprint`, or of rows
    that differ in the number of their parts.
    """
    index_N = torch.arange(count, device=device)
    view_N = index_N % views
    own_N, held_N = index_N // views, (count - 1 - view_N) // views + 1
    rows = _rows_of_tiles(count, views, size)
    return view_N, parts(own_N, held_N, rows or _rows(held_N, size[0] / size[1]))


def footprint(count: int, views: int, size: tuple[int, int]) -> tuple[float, float]:
    """Width and height in pixels of the part of a photo (H, W) that is each of `count` points' own.

    A tile, where equal tiles at most twice as wide as high, or high as wide, divide all photos;
    otherwise a square of that area.
    """
    rows, area = _rows_of_tiles(count, views, size), views * math.prod(size) / count
    height = size[0] / rows if rows else math.sqrt(area)
    return area / height, height


def _rows_of_tiles(count: int, views: int, size: tuple[int, int]) -> int | None:
    """Rows of the tiles nearest to squares, rather wide than high; None where none fit."""
    each, rest = divmod(count, views)
    if rest:
        return None
    squared = each * size[0] / size[1]  # that of the rows of squares
    few = range(1, math.isqrt(int(2 * squared)) + 1)
    fit = [rows for rows in few if each % rows == 0 and 2 * rows**2 >= squared]
    return max(fit, key=lambda rows: (min(rows, squared / rows), rows), default=None)


def cells(count: int, like: Tensor, aspect: Tensor | float = 1.0) -> Tensor:
    """Middles (K, 2), x and y, of K = `count` cells of a unit square about 0.

    They are about squares once its height is stretched to `aspect` times its width.
    """
    index_K = torch.arange(count, device=like.device)
    # A tensor, since torch.compile would make a graph for each number that Python divides.
    held = (index_K + 1).amax()
    return parts(index_K, held, _rows(held, aspect)).to(like) - 0.5


def _rows(count: Tensor, aspect: Tensor | float) -> Tensor:
    """Rows of about square parts of a photo `aspect` times as high as wide."""
    rows = ((count * aspect).sqrt() - EPS).round().clamp_min(1).long()
    return torch.minimum(rows, count)


def parts(index_N: Tensor, count: Tensor, rows: Tensor | int) -> Tensor:
    """Middles (N, 2), x and y, of the parts `index_N` of `count` of a unit square, row by row.

    Rows are of equal height and have as many parts each, or one more.
    """
    row_N = ((index_N + 1) * rows - 1) // count
    first_N = row_N * count // rows
    held_N = (row_N + 1) * count // rows - first_N
    x_N, y_N = (index_N - first_N + 0.5) / held_N, (row_N + 0.5) / rows
    return torch.stack([x_N, y_N], -1)


def sampled(
    maps_BMC: Tensor, grid: tuple[int, int, int], view_N: Tensor, place_BN2: Tensor
) -> Tensor:
    """Values (B, N, C), bilinear between the middles of patches; beyond them those of the edge.

    maps_BMC: values of the patches of a grid (V, rows, columns), by view, row and column.
    """
    maps_BVChw = maps_BMC.unflatten(1, grid).movedim(-1, 2)
    return bilinear(maps_BVChw, view_N, place_BN2[:, :, None])[..., 0].mT


def bilinear(maps_BVCHW: Tensor, view_N: Tensor, place_BNX2: Tensor) -> Tensor:
    """Values (B, C, N, X) at places of the maps `view_N`; outside of one those of its edge."""
    photos, height, width = maps_BVCHW.shape[1], *maps_BVCHW.shape[-2:]
    # All maps as one, one below another: places keep half a pixel from the edges of theirs.
    edge_2 = constant([0.5 / width, 0.5 / height], place_BNX2)
    x_BNX, y_BNX = place_BNX2.maximum(edge_2).minimum(1 - edge_2).unbind(-1)
    y_BNX = (y_BNX + view_N[:, None]) / photos
    column, grid = maps_BVCHW.transpose(1, 2).flatten(2, 3), torch.stack([x_BNX, y_BNX], -1)
    # Places have no digits in half precision, and features of float64 keep theirs.
    kind = torch.promote_types(column.dtype, grid.dtype)
    found = F.grid_sample(column.to(kind), 2 * grid.to(kind) - 1, align_corners=False)
    return found.to(column.dtype)


@full_precision
def colors_at(images_BV3HW: Tensor, side: float, view_N: Tensor, place_BN2: Tensor) -> Tensor:
    """RGB (B, N, 3): means over squares of `side` pixels around places, by a sample a pixel.

    Those of whole sides are exact. Beyond an edge, its pixels repeat.
    """
    height, width = images_BV3HW.shape[-2:]
    place_BN2, samples = place_BN2.to(images_BV3HW), max(1, math.ceil(side - EPS))
    step_P2 = side * cells(samples**2, place_BN2) / constant([width, height], place_BN2)
    return bilinear(images_BV3HW, view_N, place_BN2[:, :, None] + step_P2).mean(-1).mT


def rays_at(cameras: Cameras, view_N: Tensor, place_BN2: Tensor) -> tuple[Tensor, Tensor]:
    """World-frame origins and directions (B, N, 3) through places of photos.

    Directions have length 1 along the axis of their camera.
    """
    height, width = cameras.size
    c2w_BN44, lens_BN4 = cameras.c2w[:, view_N], cameras.intrinsics[:, view_N]
    pixel_BN2 = place_BN2.to(lens_BN4) * constant([width, height], lens_BN4)
    slope_BN2 = (pixel_BN2 - lens_BN4[..., 2:]) / lens_BN4[..., :2]
    local_BN3 = F.pad(slope_BN2, (0, 1), value=1.0)
    return c2w_BN44[..., :3, 3], torch.einsum("bnij,bnj->bni", c2w_BN44[..., :3, :3], local_BN3)

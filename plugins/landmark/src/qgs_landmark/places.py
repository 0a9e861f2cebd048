"""Places in photos: where they are, what is seen there, and the rays through them.

A place is x and y as shares of a photo's width and height; `view_N` says of which photo it is.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.constants import constant
from qgs.geometry.precision import full_precision
from qgs.types import Cameras

PLASTIC = 1.32471795724474602596
"""The real root of x^3 = x + 1; its powers step through the unit square most evenly (M. Roberts,
"The Unreasonable Effectiveness of Quasirandom Sequences", 2018: the sequence R2)."""


def patch_centres(rows: int, columns: int, device: torch.device) -> Tensor:
    """Places (rows * columns, 2) in one photo, row by row."""
    y, x = ((torch.arange(n, device=device) + 0.5) / n for n in (rows, columns))
    return torch.cartesian_prod(y, x).flip(-1)


def spread(count: int, shift_BV2: Tensor) -> tuple[Tensor, Tensor]:
    """Views (N,) of N = `count` points, in turn, and their places (B, N, 2).

    The points of a view follow the sequence R2, moved by the shift of its scene and view.
    """
    index_N = torch.arange(count, device=shift_BV2.device)
    views = shift_BV2.shape[1]
    view_N, turn_N1 = index_N % views, (index_N // views + 1)[:, None]
    # In float64: the index times a step loses the digits that float32 has after the point.
    step_2 = torch.tensor([1 / PLASTIC, 1 / PLASTIC**2], dtype=torch.float64, device=view_N.device)
    place_BN2 = (0.5 + shift_BV2.double()[:, view_N] + turn_N1 * step_2) % 1
    return view_N, place_BN2.to(shift_BV2)


def cells(count: int, like: Tensor) -> Tensor:
    """Middles (K, 2), x and y, of K = `count` equal cells of a square of side 1 about 0.

    They lie row by row in a grid as nearly square as K allows.
    """
    index_K = torch.arange(count, device=like.device)
    # The divisor next to the square root. It stays a tensor, since torch.compile would make a graph
    # for each K that Python divides.
    n_K = index_K + 1
    rows = torch.where((count % n_K == 0) & (n_K * n_K <= count), n_K, 1).amax()
    columns = count // rows
    x_K, y_K = (index_K % columns + 0.5) / columns, (index_K // columns + 0.5) / rows
    return torch.stack([x_K, y_K], -1).to(like) - 0.5


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
    """RGB (B, N, 3): means over squares of about `side` pixels around places."""
    scenes, views, _, height, width = images_BV3HW.shape
    rows, columns = (max(1, round(length / max(side, 1.0))) for length in (height, width))
    small = F.adaptive_avg_pool2d(images_BV3HW.flatten(0, 1), (rows, columns))
    pixels = small.flatten(2).mT.reshape(scenes, -1, 3)
    return sampled(pixels, (views, rows, columns), view_N, place_BN2)


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

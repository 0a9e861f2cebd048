"""Pixel rays and Plücker coordinates."""

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.precision import full_precision
from qgs.types import Cameras, Size


@full_precision
def pixel_directions(intrinsics: Tensor, size: Size) -> Tensor:
    """Return camera-frame directions with z = 1 through the pixel centres.

    intrinsics (..., 4): fx, fy, cx, cy -> (..., H, W, 3). The centre of the first pixel is (0.5,
    0.5).
    """
    centres = [
        torch.arange(side, dtype=intrinsics.dtype, device=intrinsics.device) + 0.5 for side in size
    ]
    # Rows come first in a size, but x in a pixel.
    pixels = torch.cartesian_prod(*centres).flip(-1).unflatten(0, size)
    focal, principal = intrinsics[..., None, None, :].split(2, -1)
    # z = 1, not unit length: a depth times the direction is then a point.
    return F.pad((pixels - principal) / focal, (0, 1), value=1.0)


@full_precision
def camera_rays(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Return world-frame origins and unit directions of the pixels' rays, both (..., H, W, 3)."""
    c2w = cameras.c2w
    directions = F.normalize(pixel_directions(cameras.intrinsics, cameras.size), dim=-1)
    directions = torch.einsum("...ij,...hwj->...hwi", c2w[..., :3, :3], directions)
    return c2w[..., None, None, :3, 3].expand_as(directions), directions


def plucker_rays(cameras: Cameras) -> Tensor:
    """Return maps (..., 6, H, W) of Plücker rays: moment o x d, then direction d.

    o is the camera's centre. The order of o x d and d is that of the TokenGS release.
    """
    origins, directions = camera_rays(cameras)
    moments = torch.linalg.cross(origins, directions)
    return torch.cat([moments, directions], -1).movedim(-1, -3)


@full_precision
def patch_rays(plucker: Tensor, patch_size: int) -> Tensor:
    """Return the mean Plücker ray of each patch, not renormalised.

    plucker (B, V, 6, H, W): scenes, views -> (B, V*H/P*W/P, 6) for patches of P pixels a side,
    ordered by view, row, column.
    """
    # The mean of moments and directions is a ray through the middle, a little too short.
    pooled = F.avg_pool2d(plucker.flatten(0, 1), patch_size)
    return pooled.flatten(2).mT.reshape(len(plucker), -1, 6)

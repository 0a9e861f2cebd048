"""A camera that sees a whole scene from outside: behind and above the input cameras."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.drawing.images import depth_range
from qgs.geometry.poses import look_at
from qgs.geometry.precision import full_precision
from qgs.geometry.rays import pixel_directions
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Gaussians

TILT, TURN = math.radians(28), math.radians(24)
"""How far it looks down, and from the side."""
TANGENT = math.tan(math.radians(20))
"""Of half its narrower angle of view."""
SURE = 0.05
"""Length of a mean of unit axes from which it is a direction."""
INSIDE = 0.96
"""Share of the seen points that it frames."""


def seen_points(model: QueryGaussianModel, gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """World points (P, 3) at the rendered depths of cameras (1, V), to the far end of their range.

    Depths that nothing weighs on (0) are left out.
    """
    depths = model.render(gaussians, cameras).depth[0, :, 0, ..., None].clone()
    near, far = depth_range(depths)
    local = pixel_directions(cameras.intrinsics[0], cameras.size) * depths.clamp(near, far)
    c2w = cameras.c2w[0, :, None, None]
    world = (c2w[..., :3, :3] @ local[..., None])[..., 0] + c2w[..., :3, 3]
    return world[depths[..., 0] > 0]


def level_axes(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Down and ahead (3,), by the mean of cameras (1, V); unit vectors at a right angle.

    Where the mean has none, as of cameras that face each other, by the first camera alone.
    """
    axes = cameras.c2w[0, :, :3]
    for found in (axes.mean(0), axes[0]):
        _, down, forward, _ = found.unbind(-1)
        level = forward - (forward @ down) / (down @ down).clamp_min(1e-12) * down
        if min(down.norm(), level.norm()) > SURE:
            break
    return F.normalize(down, dim=0), F.normalize(level, dim=0)


@full_precision
def overview(cameras: Cameras, points: Tensor, size: tuple[int, int]) -> Cameras:
    """A camera (1, 1) of (H, W) `size` that frames points (P, 3) and input cameras (1, V)."""
    down, level = level_axes(cameras)
    eyes = cameras.c2w[0, :, :3, 3]
    level = math.cos(TURN) * level + math.sin(TURN) * torch.linalg.cross(down, level)
    axis = math.cos(TILT) * level + math.sin(TILT) * down
    turned = look_at(torch.zeros_like(axis), axis, down)[:3, :3]
    seen, placed = points @ turned, eyes @ turned
    outside = (1 - INSIDE) / 2
    ends = seen.new_tensor([outside, 1 - outside])
    low, high = torch.quantile(seen, ends, dim=0)
    low, high = torch.minimum(low, placed.amin(0)), torch.maximum(high, placed.amax(0))
    (height, width), middle, half = size, (low + high) / 2, (high - low) / 2
    narrow = min(height, width)
    away = max(half[0] / (TANGENT * width / narrow), half[1] / (TANGENT * height / narrow))
    eye = turned @ torch.stack([middle[0], middle[1], low[2] - 1.05 * away])
    focal = narrow / 2 / TANGENT
    lens = points.new_tensor([[[focal, focal, width / 2, height / 2]]])
    c2w = look_at(eye, axis, down)[None, None]
    return Cameras(c2w.to(cameras.c2w), lens.to(cameras.intrinsics), size)

"""Scenes from outside: a camera behind and above the input cameras, and a plan from above."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from matplotlib.axes import Axes
from torch import Tensor

from qgs.drawing.images import depth_range
from qgs.geometry.poses import look_at
from qgs.geometry.precision import full_precision
from qgs.geometry.rays import pixel_directions
from qgs.types import Cameras
from qgs_viewer.figures.exhibits import Exhibit
from qgs_viewer.figures.paper import INK_HEX
from qgs_viewer.stage import SOLID

TILT, TURN = math.radians(28), math.radians(24)  # how far the overview looks down, from the side
TANGENT = math.tan(math.radians(20))  # of half its narrower angle of view
INSIDE = 0.96  # share of the seen points that it frames
SURE = 0.05  # length of a mean of unit axes from which it is a direction
PLAN_SHAPE, PLAN_MARGIN = 1.15, 1.2  # width to height
PLAN_OUTSIDE = 0.03  # share of the points that may lie outside of a plan on either side


@torch.no_grad()
def seen_points(shown: Exhibit) -> Tensor:
    """World points (P, 3) at the rendered depths of the inputs, to the far end of their range.

    Pixels without depth (0) are left out.
    """
    cameras = shown.sample.inputs.cameras
    depths = shown.model.render(shown.gaussians, cameras).depth[0, :, 0, ..., None].clone()
    near, far = depth_range(depths)
    local = pixel_directions(cameras.intrinsics[0], cameras.size) * depths.clamp(near, far)
    c2w = cameras.c2w[0, :, None, None]
    world = (c2w[..., :3, :3] @ local[..., None])[..., 0] + c2w[..., :3, 3]
    return world[depths[..., 0] > 0]


def level_axes(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Down and ahead (3,), by the mean of cameras (1, V); unit vectors at a right angle.

    By the first camera alone where the mean has no direction (cameras that face each other).
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
    level = math.cos(TURN) * level + math.sin(TURN) * torch.linalg.cross(down, level)
    axis = math.cos(TILT) * level + math.sin(TILT) * down
    turned = look_at(torch.zeros_like(axis), axis, down)[:3, :3]
    seen, placed = points @ turned, cameras.c2w[0, :, :3, 3] @ turned
    outside = (1 - INSIDE) / 2
    low, high = torch.quantile(seen, seen.new_tensor([outside, 1 - outside]), dim=0)
    low, high = torch.minimum(low, placed.amin(0)), torch.maximum(high, placed.amax(0))
    (height, width), middle, half = size, (low + high) / 2, (high - low) / 2
    narrow = min(height, width)
    away = max(half[0] / (TANGENT * width / narrow), half[1] / (TANGENT * height / narrow))
    eye = turned @ torch.stack([middle[0], middle[1], low[2] - 1.05 * away])
    focal = narrow / 2 / TANGENT
    lens = points.new_tensor([[[focal, focal, width / 2, height / 2]]])
    c2w = look_at(eye, axis, down)[None, None]
    return Cameras(c2w.to(cameras.c2w), lens.to(cameras.intrinsics), size)


@dataclass(frozen=True)
class Plan:
    """axes: columns (3, 2), right and ahead on the ground. low, high: corners (2,) of the plan."""

    axes: Tensor
    low: Tensor
    high: Tensor

    def of(self, points: Tensor) -> Tensor:
        """Places (..., 2) of world points (..., 3), float64 on the CPU."""
        return points.detach().cpu().double() @ self.axes


def plan_of(shown: Exhibit, *more: Tensor) -> Plan:
    """The plan of PLAN_SHAPE with what the inputs see, their cameras and most of `more` (P, 3)."""
    inputs = shown.sample.inputs.cameras
    down, ahead = (axis.double().cpu() for axis in level_axes(inputs))
    axes = torch.stack([torch.linalg.cross(down, ahead), ahead], -1)
    found = [inputs.c2w[0, :, :3, 3].cpu().double() @ axes]
    for points in (seen_points(shown), *more):
        places = points.cpu().double() @ axes
        ends = places.new_tensor([PLAN_OUTSIDE, 1 - PLAN_OUTSIDE])
        found.append(torch.quantile(places, ends, dim=0))
    corners = torch.cat(found)
    low, high = corners.amin(0), corners.amax(0)
    middle, half = (low + high) / 2, (high - low) / 2 * PLAN_MARGIN
    half = torch.maximum(half, half.flip(0) * half.new_tensor([PLAN_SHAPE, 1 / PLAN_SHAPE]))
    return Plan(axes, middle - half, middle + half)


def draw_ground(axis: Axes, shown: Exhibit, plan: Plan) -> None:
    """The Gaussians as pale dots in their colours, and the input cameras, on a plan."""
    gaussians = shown.gaussians
    opaque = (gaussians.opacities[0] > SOLID).cpu()
    places = plan.of(gaussians.means[0])[opaque]
    colors = gaussians.colors[0].detach().clamp(0, 1).cpu()[opaque].numpy()
    axis.scatter(*places.T.numpy(), s=5, c=colors, alpha=0.35, linewidths=0, rasterized=True)
    for c2w in shown.sample.inputs.cameras.c2w[0]:
        eye = plan.of(c2w[:3, 3])
        ahead = F.normalize(plan.of(c2w[:3, 2]), dim=0) * 0.06 * (plan.high - plan.low).max()
        side = torch.stack([-ahead[1], ahead[0]]) * 0.5
        shape = torch.stack([eye, eye + ahead + side, eye + ahead - side, eye]).T.numpy()
        axis.plot(*shape, color=INK_HEX, linewidth=0.8)
    low, high = plan.low.tolist(), plan.high.tolist()
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
    axis.spines[:].set_visible(True)
    axis.grid(visible=False)

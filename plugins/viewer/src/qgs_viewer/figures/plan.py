"""A scene from above, as a plan: across and ahead of the inputs, in the model's units."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from matplotlib.axes import Axes
from torch import Tensor

from qgs.types import Cameras
from qgs_viewer.figures.exhibits import Exhibit
from qgs_viewer.figures.overview import level_axes, seen_points
from qgs_viewer.figures.paper import INK_HEX
from qgs_viewer.stage import SOLID

SHAPE = 1.15
"""Width to height of a plan."""
MARGIN = 1.2
OUTSIDE = 0.03
"""Share of the points that may lie outside of it on either side."""


@dataclass(frozen=True)
class Plan:
    """axes: columns (3, 2), right and ahead on the ground. low, high: corners (2,) of the plan."""

    axes: Tensor
    low: Tensor
    high: Tensor

    def of(self, points: Tensor) -> Tensor:
        """Places (..., 2) of world points (..., 3), float64 on the CPU."""
        return points.detach().cpu().double() @ self.axes


def ground(cameras: Cameras) -> Tensor:
    """Right and ahead as columns (3, 2), level by the mean of cameras (1, V)."""
    down, ahead = (axis.double().cpu() for axis in level_axes(cameras))
    return torch.stack([torch.linalg.cross(down, ahead), ahead], -1)


@torch.no_grad()
def plan_of(shown: Exhibit, more: Tensor | None = None) -> Plan:
    """The plan of SHAPE that holds what the input views show, their cameras and most of `more`.

    more: world points (P, 3).
    """
    inputs = shown.sample.inputs.cameras
    axes = ground(inputs)
    points = [seen_points(shown.model, shown.gaussians, inputs), *([] if more is None else [more])]
    ends = [_ends(found.cpu().double() @ axes) for found in points]
    eyes = inputs.c2w[0, :, :3, 3].cpu().double() @ axes
    corners = torch.cat([eyes, *ends])
    low, high = corners.amin(0), corners.amax(0)
    middle, half = (low + high) / 2, (high - low) / 2 * MARGIN
    half = torch.maximum(half, half.flip(0) * half.new_tensor([SHAPE, 1 / SHAPE]))
    return Plan(axes, middle - half, middle + half)


def _ends(places: Tensor) -> Tensor:
    return torch.quantile(places, places.new_tensor([OUTSIDE, 1 - OUTSIDE]), dim=0)


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
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axis.set(xticks=[], yticks=[])
    axis.spines[:].set_visible(True)
    axis.grid(visible=False)

"""The depth of what the photos of a scene show, from cameras alone or by matching photos."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.contracts import Scene
from qgs.geometry.poses import largest_distance, look_at_depth
from qgs.geometry.rays import pixel_directions

_PHOTOS, _OTHERS = 4, (0, 1, 4)  # photos that are swept; ranks of those that they are matched with
_PLANES = 28  # at depths from 1/64 to 4 times the extent of the cameras
_TURN = 20.0  # degrees between the axes of matched photos, at most
_ALONG = 0.8  # cosine to the axis from which a motion counts as forward: it shows no depth
_COST, _MARGIN = 0.3, 0.03  # truncation of a difference of colours; least gain of a depth


def scene_depth(scene: Scene) -> float:
    """Depth of what the cameras of `scene` see, in the scene's unit; above 0.

    That of the point that all cameras look at (`look_at_depth`), else the median of a plane sweep
    over some photos, else the largest distance of the cameras. Deterministic.
    """
    c2w = scene.cameras.c2w.double()
    extent = float(largest_distance(c2w))
    if depth := float(look_at_depth(c2w)):
        return depth
    return (swept_depth(scene, extent) if extent else 0.0) or extent or 1.0


def swept_depth(scene: Scene, extent: float) -> float:
    """Median depth at which some photos agree with photos beside them; 0 where they never do.

    extent: of the cameras. Source: A Space-Sweep Approach to True Multi-Image Matching (Collins
    1996), with planes parallel to each photo.
    """
    count = len(scene)
    chosen = {int((k + 0.5) * count / _PHOTOS) for k in range(_PHOTOS)}
    planes = extent * torch.logspace(-6, 2, _PLANES, base=2).double()
    found = [_depths(scene, frame, planes, extent) for frame in sorted(chosen)]
    every = torch.cat(found)
    return float(every.median()) if len(every) else 0.0


def _depths(scene: Scene, frame: int, planes: Tensor, extent: float) -> Tensor:
    """Depths (n,) of those pixels of one photo for which one of the planes is clearly best."""
    others = _matched(scene, frame, extent)
    if not others:
        return planes[:0]
    cameras, (photo, *images) = scene.cameras, scene.images([frame, *others])
    (height, width), c2w = cameras.size, cameras.c2w.double()
    intrinsics = cameras.intrinsics.double()
    rays = pixel_directions(intrinsics[frame], cameras.size).flatten(0, 1) @ c2w[frame, :3, :3].T
    points = c2w[frame, :3, 3] + rays * planes[:, None, None]  # (planes, pixels, 3)
    costs = []
    for other, image in zip(others, images, strict=True):
        x, y, z = ((points - c2w[other, :3, 3]) @ c2w[other, :3, :3]).unbind(-1)
        fx, fy, cx, cy = intrinsics[other]
        z = torch.where(z > 1e-6 * extent, z, torch.nan)
        grid = torch.stack([(fx * x / z + cx) / width, (fy * y / z + cy) / height], -1) * 2 - 1
        grid = grid.nan_to_num(9.0).float().reshape(len(planes), height, width, 2)
        seen = F.grid_sample(image.expand(len(planes), -1, -1, -1), grid, align_corners=False)
        cost = (seen - photo).abs().mean(1, keepdim=True).clamp(max=_COST)
        # what another photo does not show speaks neither for a depth nor against it
        cost = cost.where((grid.abs() <= 1).all(-1)[:, None], torch.nan)
        costs.append(F.avg_pool2d(cost, 5, 1, 2, count_include_pad=False)[:, 0])
    total = torch.stack(costs).nanmean(0)
    least, place = total.nan_to_num(_COST).min(0)
    return planes[place[total.nanmedian(0).values - least > _MARGIN]]


def _matched(scene: Scene, frame: int, extent: float) -> list[int]:
    """Frames to match a photo with: near, turned little, and not ahead or behind."""
    c2w = scene.cameras.c2w.double()
    axes, ways = c2w[:, :3, 2], c2w[:, :3, 3] - c2w[frame, :3, 3]
    distances = ways.norm(dim=-1)
    along = (ways @ axes[frame]).abs() / distances.clamp_min(1e-12)
    fits = (axes @ axes[frame] > math.cos(math.radians(_TURN))) & (along < _ALONG)
    fits &= distances > 1e-3 * extent
    order = [int(i) for i in distances.argsort() if fits[i]]
    return sorted({order[rank] for rank in _OTHERS if rank < len(order)})

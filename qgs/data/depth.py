"""The depth of what the photos of a scene show, from cameras alone or by matching photos.

Source: A Space-Sweep Approach to True Multi-Image Matching (Collins 1996), with planes parallel to
each photo.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import Scene
from qgs.geometry.poses import largest_distance, look_at_depth
from qgs.geometry.rays import pixel_directions
from qgs.geometry.transforms import to_camera, to_pixels

# Photos that are swept, and the ranks by distance of those that each is matched with.
_PHOTOS = 4
_OTHERS = (0, 1, 4)
# Planes at depths from 1/64 to 4 times the extent of the cameras.
_PLANES = 28
# Degrees between the axes of matched photos, at most.
_TURN = 20.0
# Cosine to the axis from which on a motion counts as forward: it shows no depth.
_ALONG = 0.8
# Truncation of a difference of colours, against occlusions.
_COST = 0.3
# A depth counts where its cost is this far below the median: walls of one colour do not.
_MARGIN = 0.03


def scene_depth(scene: Scene) -> float:
    """Return the depth of what the cameras of `scene` see, in the scene's unit; above 0.

    It is that of the point that all cameras look at (`look_at_depth`), else the median of a plane
    sweep over some photos, else the largest distance of the cameras. Deterministic.
    """
    c2w = scene.cameras.c2w.double()
    extent = float(largest_distance(c2w))
    depth = float(look_at_depth(c2w))
    if not depth and extent:
        depth = swept_depth(scene, extent)
    return depth or extent or 1.0


def swept_depth(scene: Scene, extent: float) -> float:
    """Return the median depth at which photos agree with those beside them; 0 for no agreement.

    extent: of the cameras.
    """
    chosen = {int((k + 0.5) * len(scene) / _PHOTOS) for k in range(_PHOTOS)}
    planes = extent * torch.logspace(-6, 2, _PLANES, base=2).double()
    depths = torch.cat([_depths(scene, frame, planes, extent) for frame in sorted(chosen)])
    return float(depths.median()) if len(depths) else 0.0


def _depths(scene: Scene, frame: int, planes: Tensor, extent: float) -> Tensor:
    """Return depths (n,) of those pixels of a photo for which one of the planes is clearly best."""
    others = _matched(scene, frame, extent)
    if not others:
        return planes[:0]
    photo, *images = scene.images([frame, *others])
    size = scene.cameras.size
    cameras = map_tensors(Tensor.double, scene.cameras)
    pose = cameras.c2w[frame]
    rays_HW3 = pixel_directions(cameras.intrinsics[frame], size) @ pose[:3, :3].T
    points_DHW3 = pose[:3, 3] + rays_HW3 * planes[:, None, None, None]
    costs = []
    for other, image in zip(others, images, strict=True):
        seen = to_camera(points_DHW3.reshape(1, -1, 3), cameras[None, [other]])[0, 0]
        seen[seen[:, 2] <= 1e-6 * extent] = torch.nan
        grid = to_pixels(seen, cameras.intrinsics[other]) / seen.new_tensor(size[::-1]) * 2 - 1
        grid = grid.nan_to_num(9.0).float().reshape(*points_DHW3.shape[:3], 2)
        shown = F.grid_sample(image.expand(len(planes), -1, -1, -1), grid, align_corners=False)
        cost = (shown - photo).abs().mean(1, keepdim=True).clamp(max=_COST)
        # What another photo does not show speaks neither for a depth nor against it.
        cost = cost.where((grid.abs() <= 1).all(-1)[:, None], torch.nan)
        costs.append(F.avg_pool2d(cost, 5, 1, 2, count_include_pad=False)[:, 0])
    total = torch.stack(costs).nanmean(0)
    least, place = total.nan_to_num(_COST).min(0)
    return planes[place[total.nanmedian(0).values - least > _MARGIN]]


def _matched(scene: Scene, frame: int, extent: float) -> list[int]:
    """Return frames to match a photo with: near, turned little, and not ahead or behind."""
    c2w = scene.cameras.c2w.double()
    axes = c2w[:, :3, 2]
    ways = c2w[:, :3, 3] - c2w[frame, :3, 3]
    distances = ways.norm(dim=-1)
    along = (ways @ axes[frame]).abs() / distances.clamp_min(1e-12)
    fits = (axes @ axes[frame] > math.cos(math.radians(_TURN))) & (along < _ALONG)
    fits &= distances > 1e-3 * extent
    order = [int(i) for i in distances.argsort() if fits[i]]
    return sorted({order[rank] for rank in _OTHERS if rank < len(order)})

"""Gaussians without harmonics, for pages and .splat files, which show none."""

from dataclasses import replace

import torch

from qgs.geometry.harmonics import seen_colors
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.types import Cameras, Gaussians


@torch.no_grad()
def plain(gaussians: Gaussians, cameras: Cameras) -> Gaussians:
    """Return Gaussians (1, G) without `sh`, in the mean colour that cameras (1, V) see of each.

    Those count that have its mean in their image; where none has, all do.
    """
    if gaussians.sh is None:
        return gaussians
    views = cameras.shape[1]
    total = torch.zeros_like(gaussians.colors)
    mean_of_all = torch.zeros_like(total)
    count = torch.zeros_like(gaussians.opacities)[..., None]
    size = gaussians.means.new_tensor(cameras.size[::-1])
    # all views at once would take gigabytes
    for view in range(views):
        camera = cameras[:, view : view + 1]
        points = to_camera(gaussians.means, camera)
        pixels = to_pixels(points, camera.intrinsics)
        inside = (points[..., 2] > 0) & ((pixels >= 0) & (pixels <= size)).all(-1)
        seen = inside[:, 0, :, None].float()
        colors = seen_colors(gaussians, camera)[:, 0]
        total += seen * colors
        count += seen
        mean_of_all += colors / views
    mean = total / count.clamp_min(1)
    return replace(gaussians, colors=torch.where(count > 0, mean, mean_of_all), sh=None)

"""Gaussians without harmonics, for pages and .splat files, which show none."""

from dataclasses import replace

import torch

from qgs.geometry.harmonics import seen_colors
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.types import Cameras, Gaussians


@torch.no_grad()
def plain(gaussians: Gaussians, cameras: Cameras) -> Gaussians:
    """The Gaussians (1, G) without `sh`, each in the mean colour that cameras (1, V) see of it.

    Those count that have its mean in their image; where none has, all do.
    """
    if gaussians.sh is None:
        return gaussians
    total, count = torch.zeros_like(gaussians.colors), torch.zeros_like(gaussians.opacities)
    every, views = torch.zeros_like(total), cameras.shape[1]
    size = gaussians.means.new_tensor(cameras.size[::-1])
    for view in range(views):  # all at once would take gigabytes
        camera = cameras[:, view : view + 1]
        points = to_camera(gaussians.means, camera)
        pixels = to_pixels(points, camera.intrinsics)
        inside = (points[..., 2] > 0) & ((pixels >= 0) & (pixels <= size)).all(-1)
        colors, seen = seen_colors(gaussians, camera)[:, 0], inside[:, 0].float()
        total, count, every = total + seen[..., None] * colors, count + seen, every + colors / views
    mean = total / count.clamp_min(1)[..., None]
    return replace(gaussians, colors=torch.where(count[..., None] > 0, mean, every), sh=None)

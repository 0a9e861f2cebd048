"""The outlines of ellipsoids in images."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from qgs.geometry.precision import full_precision
from qgs.geometry.projection import to_camera, to_pixels
from qgs.types import Cameras, SpatialSupport


@dataclass(frozen=True)
class Ellipses:
    """Outlines in one image, pixels. whole: the ellipsoid is in front of the camera, all of it.

    centers: (N, 2) of the outlines. axes: (N, 2, 2), semi-axes as columns. Only rows where `whole`
    is true are ellipses. points: (N, 2) the ellipsoids' own centres in the image, at camera-frame
    z `depths` (N,); only those of positive depth mean something.
    """

    centers: Tensor
    axes: Tensor
    points: Tensor
    depths: Tensor
    whole: Tensor


def project_support(support: SpatialSupport, cameras: Cameras) -> Ellipses:
    """Exact perspective outlines of the first scene's ellipsoids in one camera, cameras (1, 1).

    An ellipsoid with centre c and axes A (camera frame) has the dual quadric A A^T - c c^T, whose
    image under K is the dual conic of the outline (Hartley and Zisserman, section 8.3).
    """
    rotation = cameras.w2c[0, 0, :3, :3]
    centers = to_camera(support.centers[:1], cameras)[0, 0]
    return _outlines(centers, rotation @ support.axes[0], cameras.intrinsics[0, 0])


@full_precision
def _outlines(centers_N3: Tensor, axes_N33: Tensor, intrinsics: Tensor) -> Ellipses:
    fx, fy, cx, cy = intrinsics.unbind()
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    calibration = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).view(3, 3)
    quadric = axes_N33 @ axes_N33.mT - centers_N3[:, :, None] * centers_N3[:, None, :]
    conic = calibration @ quadric @ calibration.T
    scale = -conic[:, 2, 2]
    whole = (scale > 1e-9) & (centers_N3[:, 2] > 0)
    conic = conic / torch.where(whole, scale, 1)[:, None, None]
    centers = -conic[:, :2, 2]
    shape = conic[:, :2, :2] + centers[:, :, None] * centers[:, None, :]
    lengths, directions = torch.linalg.eigh(torch.where(whole[:, None, None], shape, 0))
    axes = directions * lengths.clamp_min(0).sqrt()[:, None, :]
    depths = centers_N3[:, 2]
    in_front = torch.where(depths[:, None] > 0, centers_N3, centers_N3.new_tensor([0, 0, 1]))
    return Ellipses(centers, axes, to_pixels(in_front, intrinsics), depths, whole)

"""Transforms of points to camera frames and pixels; operations on quaternions and on Gaussians."""

from collections.abc import Sequence

import torch
from torch import Tensor

from qgs.geometry.constants import constant
from qgs.geometry.harmonics import rotated
from qgs.precision import full_precision
from qgs.types import Cameras, Gaussians

MOVED = 1e-3
"""Largest shift of a mean by rounding to a smaller dtype, as a fraction of the Gaussian's size."""


@full_precision
def quat_to_matrix(quats: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of unit quaternions (..., 4), w x y z."""
    # kornia has the same function, which takes half as long again: this one runs in every step.
    w, x, y, z = quats.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


@full_precision
def unit(vectors: Tensor, otherwise: Sequence[float] = (1.0, 0.0, 0.0, 0.0)) -> Tensor:
    """Normalise vectors (..., C); zero vectors become `otherwise`.

    The default of `otherwise` is the identity quaternion, w x y z.
    """
    length = vectors.norm(dim=-1, keepdim=True)
    divisor = torch.where(length > 0, length, 1)
    return torch.where(length > 0, vectors / divisor, constant(otherwise, vectors))


@full_precision
def quat_product(left: Tensor, right: Tensor) -> Tensor:
    """Return Hamilton products (..., 4), w x y z: rotation by `right`, then rotation by `left`."""
    w, v = left.split((1, 3), -1)
    w2, v2 = right.split((1, 3), -1)
    real = w * w2 - (v * v2).sum(-1, keepdim=True)
    return torch.cat([real, w * v2 + w2 * v + torch.linalg.cross(v, v2)], -1)


@full_precision
def to_camera(points: Tensor, cameras: Cameras) -> Tensor:
    """Transform P world points (B, P, 3) to the frames of cameras (B, V) -> (B, V, P, 3)."""
    w2c = cameras.w2c
    return points[:, None] @ w2c[..., :3, :3].mT + w2c[..., None, :3, 3]


@full_precision
def to_pixels(camera_points: Tensor, intrinsics: Tensor) -> Tensor:
    """Project camera-frame points (..., P, 3) with intrinsics (..., 4) to pixels (..., P, 2).

    A point at z = 0 gives inf or NaN.
    """
    focal = intrinsics[..., None, :2]
    principal = intrinsics[..., None, 2:]
    return torch.addcmul(principal, focal, camera_points[..., :2] / camera_points[..., 2:])


def depths_in_view(points: Tensor, cameras: Cameras) -> Tensor:
    """Return depths (V, P) of points (P, 3) from cameras (1, V); NaN for points out of view."""
    local = to_camera(points[None], cameras)[0]
    depths = local[..., 2]
    pixels = to_pixels(local, cameras.intrinsics[0])
    inside = (pixels >= 0) & (pixels <= pixels.new_tensor(cameras.size[::-1]))
    return depths.where(inside.all(-1) & (depths > 0), torch.nan)


@full_precision
def moved(gaussians: Gaussians, pose: Tensor, factor: float) -> Gaussians:
    """Scale Gaussians by `factor` about the origin, then move them by the rigid `pose` (4, 4).

    Means are computed in float64, and returned in the dtype that `narrowed` chooses.
    """
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    pose = pose.to(gaussians.means.device, torch.float64)
    rotation = pose[:3, :3]
    turn = rotation_matrix_to_quaternion(rotation).to(gaussians.quats).expand_as(gaussians.quats)
    placed = gaussians.replace(
        means=gaussians.means.double() * factor @ rotation.T + pose[:3, 3],
        scales=gaussians.scales * factor,
        quats=quat_product(turn, gaussians.quats),
        sh=None if gaussians.sh is None else rotated(gaussians.sh, rotation),
    )
    return narrowed(placed)


def narrowed(gaussians: Gaussians) -> Gaussians:
    """Return `gaussians` with means in the dtype of the scales, unless rounding moves them too far.

    If more than half of the means move by more than MOVED times the size of their Gaussian, as in
    map coordinates, the Gaussians are returned unchanged.
    """
    means = gaussians.means.to(gaussians.scales.dtype)
    off = (means - gaussians.means).norm(dim=-1) > MOVED * gaussians.scales.norm(dim=-1)
    return gaussians if off.float().mean() > 0.5 else gaussians.replace(means=means)

"""Points into cameras and pixels, quaternions to rotation matrices and back, worlds to worlds."""

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.harmonics import rotated
from qgs.geometry.precision import full_precision
from qgs.types import Cameras, Gaussians


@full_precision
def quat_to_matrix(quats: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4), w x y z."""
    w, x, y, z = quats.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


@full_precision
def to_camera(points: Tensor, cameras: Cameras) -> Tensor:
    """Camera-frame points (B, V, P, 3) of world points (B, P, 3) in cameras (B, V)."""
    w2c = cameras.w2c
    return points[:, None] @ w2c[..., :3, :3].transpose(-1, -2) + w2c[..., None, :3, 3]


@full_precision
def to_pixels(camera_points: Tensor, intrinsics: Tensor) -> Tensor:
    """Pixels (..., P, 2) of camera-frame points (..., P, 3) under intrinsics (..., 4).

    The division by z is unguarded: a point at z = 0 gives inf or NaN.
    """
    focal, principal = intrinsics[..., None, :2], intrinsics[..., None, 2:]
    return torch.addcmul(principal, focal, camera_points[..., :2] / camera_points[..., 2:])


@full_precision
def moved(gaussians: Gaussians, pose: Tensor, factor: float) -> Gaussians:
    """The Gaussians enlarged by `factor` about the origin, then placed by the rigid pose (4, 4)."""
    pose = pose.to(gaussians.means)
    turn = matrix_to_quat(pose[:3, :3])
    return replace(
        gaussians,
        means=gaussians.means * factor @ pose[:3, :3].T + pose[:3, 3],
        scales=gaussians.scales * factor,
        quats=_product(turn, gaussians.quats),
        sh=None if gaussians.sh is None else rotated(gaussians.sh, pose[:3, :3]),
    )


def matrix_to_quat(rotation: Tensor) -> Tensor:
    """The unit quaternion (4,), w x y z, w not negative, of a rotation matrix (3, 3)."""
    m = rotation
    # K of Bar-Itzhack (2000), whose largest eigenvalue has the quaternion x y z w as its vector:
    # it needs no case for a small trace.
    symmetric = m + m.T - torch.eye(3).to(m) * m.trace()
    axis = torch.stack([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    k = torch.cat(
        [torch.cat([symmetric, axis[:, None]], 1), torch.cat([axis, m.trace()[None]])[None]]
    )
    x, y, z, w = torch.linalg.eigh(k.double()).eigenvectors[:, -1].to(m)
    quat = F.normalize(torch.stack([w, x, y, z]), dim=0)
    return torch.where(w < 0, -quat, quat)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Quaternion products (..., 4)."""
    w, vector = a[..., :1], a[..., 1:].expand_as(b[..., 1:])
    real = w * b[..., :1] - (vector * b[..., 1:]).sum(-1, keepdim=True)
    cross = torch.linalg.cross(vector, b[..., 1:], dim=-1)
    return torch.cat([real, w * b[..., 1:] + b[..., :1] * vector + cross], -1)

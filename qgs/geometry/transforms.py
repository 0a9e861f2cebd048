"""Points into cameras and pixels, quaternions to rotation matrices."""

import torch
from torch import Tensor

from qgs.geometry.precision import full_precision
from qgs.types import Cameras


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

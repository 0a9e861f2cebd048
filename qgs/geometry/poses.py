"""Transforms of camera poses to the coordinate frame and scale of the model (TokenGS release).

V is the number of cameras; poses are camera-to-world, with OpenCV axes.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.constants import constant
from qgs.precision import full_precision

# Mean squared sine of the axes' angles to their mean; 1 degree.
_PARALLEL = 3e-4


@full_precision
def reference_pose(frame: str, c2w: Tensor) -> Tensor:
    """Return the pose (..., 4, 4) that becomes the identity in the model's frame.

    frame: value of the recipe's option `views.frame`. c2w: poses (..., V, 4, 4) of the input
        cameras.
    """
    if frame == "given":
        return torch.eye(4).to(c2w).expand_as(c2w[..., 0, :, :])
    return mean_camera(c2w) if frame == "mean_cam" else c2w[..., 0, :, :]


@full_precision
def mean_camera(c2w: Tensor) -> Tensor:
    """Compute the mean pose (..., 4, 4) of poses c2w (..., V, 4, 4).

    It has the mean position, and the mean forward and down axes, orthonormalised by Gram-Schmidt.
    """
    _, down, forward, position = c2w.mean(dim=-3)[..., :3, :].unbind(-1)
    return look_at(position, forward, down)


@full_precision
def look_at(eye: Tensor, forward: Tensor, down: Tensor) -> Tensor:
    """Return OpenCV poses (..., 4, 4) at position `eye` (..., 3) that look along `forward`.

    forward: a vector (..., 3). down: a vector (..., 3) that points down in the image; it need not
        be orthogonal to `forward`.
    """
    forward = F.normalize(forward, dim=-1)
    down = F.normalize(down - (down * forward).sum(-1, keepdim=True) * forward, dim=-1)
    # Down is made orthogonal first, so that the view direction stays exact.
    right = torch.linalg.cross(down, forward)
    pose = F.pad(torch.stack([right, down, forward, eye], -1), (0, 0, 0, 1))
    pose[..., 3, 3] = 1
    return pose


@full_precision
def relative_to(reference: Tensor, c2w: Tensor) -> Tensor:
    """Return poses c2w (..., V, 4, 4) relative to the pose `reference` (..., 4, 4)."""
    return torch.linalg.inv(reference)[..., None, :, :] @ c2w


@full_precision
def scaled(c2w: Tensor, scale: Tensor | float) -> Tensor:
    """Return poses with translations multiplied by the number `scale`."""
    result = c2w.clone()
    result[..., :3, 3] *= scale
    return result


@full_precision
def largest_distance(c2w: Tensor) -> Tensor:
    """Return the largest distance (...) from the first camera of (..., V, 4, 4) to any other."""
    centres = c2w[..., :3, 3]
    return (centres - centres[..., :1, :]).norm(dim=-1).amax(-1)


@full_precision
def look_at_depth(c2w: Tensor) -> Tensor:
    """Return the depth (0-d) of the point that cameras c2w (V, 4, 4) look at: median over cameras.

    The point has the least sum of squared distances to the optical axes. The result is 0 if the
    axes are parallel within about a degree. It is also 0 if, for more than a quarter of the
    cameras, the point lies behind the camera or more than 30 degrees off its optical axis.
    """
    axes = c2w[:, :3, 2]
    centres = c2w[:, :3, 3]
    # The squared distance of a point to a line is its part across the line.
    across = torch.eye(3).to(c2w) - axes[:, :, None] * axes[:, None]
    middle = centres.mean(0)
    normal = across.mean(0)
    right = (across @ (centres - middle)[..., None]).mean(0)[:, 0]
    if torch.linalg.eigvalsh(normal)[0] < _PARALLEL:
        return c2w.new_zeros(())
    point = middle + torch.linalg.solve(normal, right)
    ways = point - centres
    depths = (ways * axes).sum(-1)
    ahead = depths > math.cos(math.radians(30)) * ways.norm(dim=-1)
    return depths.median() if ahead.float().mean() >= 0.75 else c2w.new_zeros(())


@full_precision
def mirrored(c2w: Tensor) -> Tensor:
    """Return the poses of cameras after mirroring the scene in x.

    Rotations R become F R F and translations t become F t, with F = diag(-1, 1, 1).
    """
    # On both sides, because a matrix mirrored once is not a rotation.
    flip = torch.diag(constant([-1.0, 1.0, 1.0, 1.0], c2w))
    return flip @ c2w @ flip

"""EWA projection of Gaussians into images, in autograd (Zwicker et al. 2001; gsplat 1.5.3).

Shapes: B scenes, V views, G Gaussians. The covariance never appears as such: a Gaussian is the
factor R S of its covariance, and its image the 2x3 factor J W R S, whose rows are `row_x`, `row_y`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.rotations import quat_to_matrix
from qgs.types import Cameras, Gaussians

CLAMP_MARGIN = 0.15  # of the image's width or height: beyond it the Jacobian is held constant


@dataclass(frozen=True)
class Splats:
    """Gaussians as cameras see them, each field (B, V, G, ...).

    means: (..., 2) pixels. conics: (..., 3) entries xx, xy, yy of the inverse covariance, pixel^-2.
    depths: camera-frame z. deviations: (..., 2) standard deviations along x and y, pixels, without
    gradient. visible: False for what near, far or an overflow drops; the other fields are finite
    placeholders there, with zero gradients.
    """

    means: Tensor
    conics: Tensor
    depths: Tensor
    deviations: Tensor
    visible: Tensor


def project(
    gaussians: Gaussians, cameras: Cameras, near: float, far: float, dilation: float
) -> Splats:
    """Splats (B, V, G) of Gaussians (B, G) in cameras (B, V) of one dtype, autocast being off.

    Differentiable in means, scales, quats (normalised here), c2w and intrinsics. In the Jacobian,
    x/z and y/z are clamped to 15 % of the image beyond its borders, as gsplat does.
    """
    w2c = cameras.w2c
    factors = (
        quat_to_matrix(F.normalize(gaussians.quats, dim=-1)) * gaussians.scales[..., None, :]
    )  # (B, G, 3, 3)
    position = w2c[..., :3, :3] @ gaussians.means.transpose(-1, -2)[:, None] + w2c[..., :3, 3:]
    x, y, z = position.unbind(-2)  # (B, V, G) each
    in_range = (z >= near) & (z <= far)
    z = torch.where(in_range, z, 1.0)
    x, y = (torch.where(in_range, value, 0.0) / z for value in (x, y))

    fx, fy, cx, cy = cameras.intrinsics[..., None, :].unbind(-1)  # (B, V, 1) each
    height, width = cameras.size
    means = torch.stack([torch.addcmul(cx, fx, x), torch.addcmul(cy, fy, y)], -1)
    x, y = _clamped(x, fx, cx, width), _clamped(y, fy, cy, height)

    turned = w2c[..., :3, :3] @ factors.permute(0, 2, 1, 3).flatten(2)[:, None]
    rows = turned.unflatten(-1, (-1, 3))  # (B, V, 3, G, 3): rows of W R S
    row_x = (fx / z)[..., None] * (rows[:, :, 0] - x[..., None] * rows[:, :, 2])
    row_y = (fy / z)[..., None] * (rows[:, :, 1] - y[..., None] * rows[:, :, 2])
    xx, xy, yy = (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)
    minors = torch.linalg.cross(row_x, row_y, dim=-1)
    # Cauchy-Binet: unlike xx * yy - xy^2 this does not cancel for needles.
    determinant = (minors * minors).sum(-1) + dilation * (xx + yy) + dilation * dilation
    usable = torch.isfinite(determinant) & (determinant > 0)
    determinant = torch.where(usable, determinant, 1.0)
    conics = torch.stack([yy + dilation, -xy, xx + dilation], -1) / determinant[..., None]
    visible = in_range & usable
    deviations = torch.stack([xx, yy], -1).detach().add(dilation).sqrt()
    return Splats(
        means=means,
        conics=torch.where(usable[..., None], conics, 0.0),
        depths=z,
        deviations=torch.where(visible[..., None], deviations, 0.0),
        visible=visible,
    )


def _clamped(slope: Tensor, focal: Tensor, principal: Tensor, size: int) -> Tensor:
    margin = CLAMP_MARGIN * size
    low, high = (-margin - principal) / focal, (size + margin - principal) / focal
    return torch.minimum(torch.maximum(slope, low), high)

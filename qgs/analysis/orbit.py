"""A smooth closed camera path past the input cameras."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.types import Cameras


def orbit(inputs: Cameras, depth: float, frames: int, sway: float = 0.12) -> Cameras:
    """A loop (1, frames) that runs past the input cameras (1, V), there and back.

    The base path is the input poses under a Gaussian kernel, so it has no corners. Around it the
    camera sways by `sway` times `depth`, and looks at what lies `depth` world units ahead.
    """
    angles = torch.arange(frames, device=inputs.c2w.device) * (2 * math.pi / frames)
    poses = _smoothed(inputs.c2w[0], (1 - angles.cos()) / 2)
    right, down, forward, centre = poses[:, :3].unbind(-1)
    focus = centre + depth * forward
    reach = sway * depth
    eye = centre + reach * angles.sin()[:, None] * right
    eye = eye - reach / 2 * angles.cos()[:, None] * down
    c2w = look_at(eye, focus - eye, down)
    intrinsics = inputs.intrinsics[:, :1].expand(1, frames, 4)
    return Cameras(c2w[None], intrinsics, inputs.size)


def look_at(eye: Tensor, forward: Tensor, down: Tensor) -> Tensor:
    """OpenCV poses c2w (..., 4, 4) at eye (..., 3), looking along `forward`, upright by `down`."""
    forward = F.normalize(forward, dim=-1)
    down = F.normalize(down - (down * forward).sum(-1, keepdim=True) * forward, dim=-1)
    right = torch.linalg.cross(down, forward)
    top = torch.stack([right, down, forward, eye], -1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)


def _smoothed(c2w_V44: Tensor, times_T: Tensor) -> Tensor:
    """Poses (T, 4, 4) at times from 0, the first input, to 1, the last."""
    count = c2w_V44.shape[0]
    steps = times_T[:, None] * (count - 1) - torch.arange(count, device=times_T.device)
    weights_TV = torch.softmax(-0.5 * (steps / 0.6) ** 2, -1)
    mean = torch.einsum("tv,vij->tij", weights_TV, c2w_V44)
    _, down, forward, centre = mean[:, :3].unbind(-1)
    return look_at(centre, forward, down)

"""Make camera paths around a scene or along its photos, or read them from a file."""

import json
import math
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from upath import UPath

from qgs.data.photos.nerfstudio import read_transforms
from qgs.data.photos.reader import PhotoFrame, pose_problems
from qgs.geometry.poses import look_at, mean_camera
from qgs.reconstruction.saving import SWAY, orbit
from qgs.types import Cameras, Size

KINDS = ("orbit", "spiral", "walk")
# Photos over which a walk is smoothed.
_SMOOTH = 1.5
# Of a spiral.
_TURNS = 2.0


def path_of(kind: str, cameras: Cameras, depth: float, frames: int) -> Tensor:
    """Return poses (frames, 4, 4) of a `kind` of path in KINDS, for a scene with `cameras` (1, V).

    depth: distance from the cameras to what they show.
    """
    if kind == "orbit":
        return orbit(cameras, depth, frames).c2w[0]
    poses = cameras.c2w[0]
    return spiral(poses, depth, frames) if kind == "spiral" else walk(poses, frames)


def spiral(c2w: Tensor, depth: float, frames: int) -> Tensor:
    """Return poses (frames, 4, 4) that circle the mean of `c2w` (V, 4, 4) and look at one point.

    While circling, the poses move forward and back, as in LLFF's spirals (Mildenhall et al., 2019).
    The point lies `depth` in front of the mean pose.
    """
    right, down, forward, centre = mean_camera(c2w)[:3].unbind(-1)
    angle = torch.arange(frames).to(c2w) * (2 * math.pi * _TURNS / frames)
    reach = SWAY * depth
    across = reach * (angle.cos()[:, None] * right + angle.sin()[:, None] * down)
    eye = centre + across + reach * (angle / _TURNS).sin()[:, None] * forward
    return look_at(eye, centre + depth * forward - eye, down.expand_as(eye))


def walk(c2w: Tensor, frames: int) -> Tensor:
    """Return smoothed poses (frames, 4, 4) along the poses `c2w` (V, 4, 4) of photos, in order."""
    count = len(c2w)
    # a mean of poses is none: `mean_camera` makes one of its axes
    times = torch.linspace(0, count - 1, frames).to(c2w)
    gaps = times[:, None] - torch.arange(count).to(c2w)
    weights = torch.softmax(-0.5 * (gaps / min(_SMOOTH, count / 4)) ** 2, -1)
    return mean_camera(torch.einsum("tv,vij->tij", weights, c2w)[:, None])


def read_path(file: Path, size: Size) -> tuple[Tensor, Tensor]:
    """Read a camera path: camera-to-world (T, 4, 4), OpenCV axes, and fx and fy (T, 2), float64.

    file: a camera path of nerfstudio's viewer, or a transforms file. size: (H, W) of the video, of
    whose pixels the focal lengths are. Raises ValueError for any other file.
    """
    try:
        data = json.loads(file.read_bytes())
        if entries := data.get("camera_path"):
            read = [_keyframe(entry, size) for entry in entries]
        else:
            read = [_photo(frame, size) for frame in read_transforms(UPath(file))]
        poses = np.stack([pose for pose, _ in read])
        for problem in chain(*map(pose_problems, poses)):
            raise ValueError(problem)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{file} is not a camera path ({type(error).__name__}: {error}): give a path that "
            "nerfstudio's viewer saved, a transforms.json, or one of " + ", ".join(KINDS)
        ) from error
    # focal lengths of both axes are the same: paths list one angle
    focal = torch.tensor([[focal] * 2 for _, focal in read], dtype=torch.float64)
    return torch.from_numpy(poses), focal


def _keyframe(entry: Mapping[str, Any], size: Size) -> tuple[np.ndarray, float]:
    """Return the OpenCV camera-to-world pose (4, 4) and fy in pixels of nerfstudio's keyframe."""
    pose = np.array(entry["camera_to_world"], np.float64).reshape(4, 4)
    # OpenGL's axes y and z point the other way
    return pose * [1, -1, -1, 1], focal_length(float(entry.get("fov") or 50.0), size[0])


def _photo(frame: PhotoFrame, size: Size) -> tuple[np.ndarray, float]:
    """Return the pose (4, 4) of a photo of a transforms file, and its fy in pixels of `size`."""
    if frame.problems or frame.size is None:
        raise ValueError(
            f"{frame.name}: {next(iter(frame.problems), 'the photo has no size: add h and w')}"
        )
    return frame.c2w, frame.intrinsics[1] * size[0] / frame.size[0]


def focal_length(angle: float, height: int) -> float:
    """Return the focal length in pixels for a vertical `angle` of view in degrees."""
    return height / 2 / math.tan(math.radians(angle) / 2)

"""Intrinsics and poses of cameras."""

import math

import numpy as np
from numpy.typing import ArrayLike


def lens(fov: float, across: int, size: tuple[int, int]) -> np.ndarray:
    """Return intrinsics fx, fy, cx, cy in pixels for images of `size` (H, W).

    fov: field of view in degrees over `across` pixels.
    """
    height, width = size
    focal = across / 2 / math.tan(math.radians(fov) / 2)
    return np.array([focal, focal, width / 2, height / 2])


def look_along(eyes: np.ndarray, forward: np.ndarray, roll: ArrayLike = 0.0) -> np.ndarray:
    """Return poses c2w (F, 4, 4) with OpenCV axes for F cameras in a world whose z axis is up.

    eyes: camera centres (F, 3). forward: viewing directions (F, 3). roll: angles (F,) in radians
    about the viewing direction; 0 keeps cameras level.
    """
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    cos = np.cos(roll)[..., None]
    sin = np.sin(roll)[..., None]
    turned = cos * right + sin * down
    down = cos * down - sin * right
    c2w = np.tile(np.eye(4), (len(eyes), 1, 1))
    c2w[:, :3] = np.stack([turned, down, forward, eyes], -1)
    return c2w

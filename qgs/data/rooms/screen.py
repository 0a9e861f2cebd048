"""Where shapes are on the screen, so that a shape is tested by the rays near it alone."""

from __future__ import annotations

import numpy as np
from numba import njit

from qgs.data.rooms.textures import INNER

_PLANE = 0.02  # shapes are clipped where they come nearer to the camera's plane than this


@njit(**INNER)
def _corners(shapes, i, c2w, corners):
    """Write the camera-frame positions (8, 3) of the corners of the box around shape i."""
    for k in range(8):
        lx = shapes[i, 4] if k & 1 else -shapes[i, 4]
        ly = shapes[i, 5] if k & 2 else -shapes[i, 5]
        x = shapes[i, 1] + shapes[i, 7] * lx - shapes[i, 8] * ly - c2w[0, 3]
        y = shapes[i, 2] + shapes[i, 8] * lx + shapes[i, 7] * ly - c2w[1, 3]
        z = shapes[i, 3] + (shapes[i, 6] if k & 4 else -shapes[i, 6]) - c2w[2, 3]
        for a in range(3):
            corners[k, a] = c2w[0, a] * x + c2w[1, a] * y + c2w[2, a] * z


@njit(**INNER)
def _clipped(corners, points):
    """Write the corners in front of the camera, and where edges cross its plane; their number."""
    n = 0
    for k in range(8):
        z = corners[k, 2]
        if z > _PLANE:
            points[n, 0], points[n, 1], points[n, 2] = corners[k, 0], corners[k, 1], z
            n += 1
        for axis in range(3):
            other = k | (1 << axis)
            if other != k and (z > _PLANE) != (corners[other, 2] > _PLANE):
                w = (_PLANE - z) / (corners[other, 2] - z)
                for a in range(3):
                    points[n, a] = corners[k, a] + w * (corners[other, a] - corners[k, a])
                n += 1
    return n


@njit(**INNER)
def screen_bounds(shapes, c2w, intrinsics):
    """(S, 4) u0, u1, v0, v1 in pixels of every shape; u0 > u1 for one behind the camera."""
    bounds = np.empty((shapes.shape[0], 4))
    corners, points = np.empty((8, 3)), np.empty((20, 3))
    for i in range(shapes.shape[0]):
        _corners(shapes, i, c2w, corners)
        u0, u1, v0, v1 = np.inf, -np.inf, np.inf, -np.inf
        for k in range(_clipped(corners, points)):
            u = intrinsics[0] * points[k, 0] / points[k, 2] + intrinsics[2]
            v = intrinsics[1] * points[k, 1] / points[k, 2] + intrinsics[3]
            u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
        bounds[i, 0], bounds[i, 1], bounds[i, 2], bounds[i, 3] = u0, u1, v0, v1
    return bounds

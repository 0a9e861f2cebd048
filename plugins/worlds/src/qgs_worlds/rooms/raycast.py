"""Which surface each ray of an image meets first: shapes by the screen rows that they cover."""

import math

import numpy as np
from numba import njit

from qgs_worlds.rooms import shapes as s
from qgs_worlds.rooms.intersections import (
    ONE,
    ZERO,
    hit_box,
    hit_cylinder,
    hit_sphere,
    local,
    local_point,
)
from qgs_worlds.rooms.textures import INNER

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
def covered(corners, points, intrinsics):
    """u0, u1, v0, v1 in pixels of a box by its corners (8, 3); u0 > u1 behind the camera.

    points: (20, 3), memory to work in.
    """
    u0, u1, v0, v1 = np.inf, -np.inf, np.inf, -np.inf
    for k in range(_clipped(corners, points)):
        u = intrinsics[0] * points[k, 0] / points[k, 2] + intrinsics[2]
        v = intrinsics[1] * points[k, 1] / points[k, 2] + intrinsics[3]
        u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
    return u0, u1, v0, v1


@njit(**INNER)
def screen_bounds(shapes, c2w, intrinsics):
    """(S, 4) u0, u1, v0, v1 in pixels of every shape; u0 > u1 for one behind the camera."""
    bounds = np.empty((shapes.shape[0], 4))
    corners, points = np.empty((8, 3)), np.empty((20, 3))
    for i in range(shapes.shape[0]):
        _corners(shapes, i, c2w, corners)
        u0, u1, v0, v1 = covered(corners, points, intrinsics)
        bounds[i, 0], bounds[i, 1], bounds[i, 2], bounds[i, 3] = u0, u1, v0, v1
    return bounds


WALLS = 6  # codes 0 to 5 are walls; part p of shape i is code WALLS + 4 i + p
_HALF = np.float32(0.5)
_X, _Y, _Z = np.float32(0), np.float32(2), np.float32(4)


@njit(**INNER)
def _walls(t, code, steps, o, base, step, size):
    """Where the rays of a row leave the room, and by which face."""
    for k in range(t.shape[0]):
        x, y = base[0] + steps[k] * step[0], base[1] + steps[k] * step[1]
        z = base[2] + steps[k] * step[2]
        tx = (math.copysign(_HALF * size[0], x) - o[0]) / x
        ty = (math.copysign(_HALF * size[1], y) - o[1]) / y
        tz = ((size[2] if z > ZERO else ZERO) - o[2]) / z
        first_x, first_y = (tx <= ty) & (tx <= tz), ty <= tz
        t[k] = tx if first_x else (ty if first_y else tz)
        along = x if first_x else (y if first_y else z)
        face = _X if first_x else (_Y if first_y else _Z)
        code[k] = face + (ONE if along > ZERO else ZERO)


@njit(**INNER)
def _box_row(t, code, steps, o, base, step, h, own):
    for k in range(t.shape[0]):
        x, y = base[0] + steps[k] * step[0], base[1] + steps[k] * step[1]
        hit, near_x, near_y = hit_box(o, (x, y, base[2] + steps[k] * step[2]), h)
        closer = hit < t[k]
        part = own if hit == near_x else (own + ONE if hit == near_y else own + ONE + ONE)
        t[k] = hit if closer else t[k]
        code[k] = part if closer else code[k]


@njit(**INNER)
def _sphere_row(t, code, steps, o, base, step, radius, own):
    for k in range(t.shape[0]):
        x, y = base[0] + steps[k] * step[0], base[1] + steps[k] * step[1]
        hit = hit_sphere(o, (x, y, base[2] + steps[k] * step[2]), radius)
        closer = hit < t[k]
        t[k] = hit if closer else t[k]
        code[k] = own if closer else code[k]


@njit(**INNER)
def _cylinder_row(t, code, steps, o, base, step, radius, half, own):
    for k in range(t.shape[0]):
        x, y = base[0] + steps[k] * step[0], base[1] + steps[k] * step[1]
        d = (x, y, base[2] + steps[k] * step[2])
        hit, cap = hit_cylinder(o, d, radius, half)
        closer = hit < t[k]
        t[k] = hit if closer else t[k]
        code[k] = (own + ONE if hit == cap else own) if closer else code[k]


@njit(**INNER)
def span(low, high, samples, first, count):
    """Indices of the samples between two screen coordinates, among `count` from pixel `first`."""
    low, high = (low - first) * samples - 0.5, (high - first) * samples + 0.5
    return int(min(max(low, 0.0), count)), int(min(max(high + 1, 0.0), count))


@njit(**INNER)
def row_base(rays, v):
    """Direction of the ray at u = 0 of row v."""
    return (
        np.float32(rays[0, 0] + v * rays[0, 2]),
        np.float32(rays[1, 0] + v * rays[1, 2]),
        np.float32(rays[2, 0] + v * rays[2, 2]),
    )


@njit(**INNER)
def ray_basis(c2w, intrinsics):
    """(3, 3) B with d = B (1, u, v) in the world frame."""
    rays = np.empty((3, 3))
    for a in range(3):
        rays[a, 1], rays[a, 2] = c2w[a, 0] / intrinsics[0], c2w[a, 1] / intrinsics[1]
        rays[a, 0] = c2w[a, 2] - intrinsics[2] * rays[a, 1] - intrinsics[3] * rays[a, 2]
    return rays


@njit(**INNER)
def trace(t, code, top, samples, shapes, size, bounds, c2w, rays):
    """Write t and code (R, C) float32 of rays from pixel row `top` on, at pixel sub-centres."""
    rows, columns = t.shape
    steps = np.empty(columns, np.float32)
    for j in range(columns):
        steps[j] = (j + 0.5) / samples
    step = (np.float32(rays[0, 1]), np.float32(rays[1, 1]), np.float32(rays[2, 1]))
    o = (np.float32(c2w[0, 3]), np.float32(c2w[1, 3]), np.float32(c2w[2, 3]))
    extent = (np.float32(size[0]), np.float32(size[1]), np.float32(size[2]))
    for i in range(rows):
        _walls(t[i], code[i], steps, o, row_base(rays, top + (i + 0.5) / samples), step, extent)
    for k in range(shapes.shape[0]):
        first, last = span(bounds[k, 0], bounds[k, 1], samples, 0.0, columns)
        above, below = span(bounds[k, 2], bounds[k, 3], samples, top, rows)
        if first >= last:
            continue
        lo = local_point(shapes, k, o[0], o[1], o[2])
        ls = local(shapes, k, step[0], step[1], step[2])
        h = (shapes[k, 4], shapes[k, 5], shapes[k, 6])
        own = np.float32(WALLS + 4 * k)
        along = steps[first:last]
        for i in range(above, below):
            base = row_base(rays, top + (i + 0.5) / samples)
            lb = local(shapes, k, base[0], base[1], base[2])
            near, codes = t[i, first:last], code[i, first:last]
            if shapes[k, 0] == s.BOX:
                _box_row(near, codes, along, lo, lb, ls, h, own)
            elif shapes[k, 0] == s.SPHERE:
                _sphere_row(near, codes, along, lo, lb, ls, h[0], own)
            else:
                _cylinder_row(near, codes, along, lo, lb, ls, h[0], h[2], own)

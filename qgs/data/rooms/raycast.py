"""The ray caster: exact intersections, one nearest hit per sample, no bounces.

A ray is o + t d with d = R (x, y, 1), so that t is the camera-frame z of the hit. Before an image
is cast, `visible` bounds each shape on the screen and sorts the shapes by their nearest z; a ray
tests those that overlap its pixel, nearest first, and a ray stops at the first shape that
begins behind what it has hit.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from qgs.data.rooms import shapes as s
from qgs.data.rooms.shading import shade
from qgs.data.rooms.textures import OPTIONS

NEAR = 0.02
TILE = 8
_BOX, _SPHERE = s.BOX, s.SPHERE


@njit(**OPTIONS)
def _away_from_zero(x):
    if abs(x) > 1e-9:
        return x
    return 1e-9 if x > 0 else -1e-9


@njit(**OPTIONS)
def _slab(o, d, h):
    """Where a ray is between -h and h along one axis: entry and exit."""
    inverse = 1 / _away_from_zero(d)
    a, b = (-h - o) * inverse, (h - o) * inverse
    return min(a, b), max(a, b)


@njit(**OPTIONS)
def _hit_box(o, d, h):
    near_x, far_x = _slab(o[0], d[0], h[0])
    near_y, far_y = _slab(o[1], d[1], h[1])
    near_z, far_z = _slab(o[2], d[2], h[2])
    near, far = max(near_x, near_y, near_z), min(far_x, far_y, far_z)
    return near if NEAR < near <= far else np.inf


@njit(**OPTIONS)
def _hit_sphere(o, d, radius):
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]
    c = o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - radius * radius
    root = b * b - a * c
    if root < 0:
        return np.inf
    t = (-b - math.sqrt(root)) / a
    return t if t > NEAR else np.inf


@njit(**OPTIONS)
def _hit_cylinder(o, d, radius, half):
    near, far = _slab(o[2], d[2], half)
    a = _away_from_zero(d[0] * d[0] + d[1] * d[1])
    b = o[0] * d[0] + o[1] * d[1]
    root = b * b - a * (o[0] * o[0] + o[1] * o[1] - radius * radius)
    if root < 0:
        return np.inf
    root = math.sqrt(root)
    near, far = max(near, (-b - root) / a), min(far, (-b + root) / a)
    return near if NEAR < near <= far else np.inf


@njit(**OPTIONS)
def hit(shapes, i, o, d):
    """t at which the ray o + t d enters shape i, or inf."""
    cos, sin = shapes[i, 7], shapes[i, 8]
    x, y, z = o[0] - shapes[i, 1], o[1] - shapes[i, 2], o[2] - shapes[i, 3]
    lo = (cos * x + sin * y, cos * y - sin * x, z)
    ld = (cos * d[0] + sin * d[1], cos * d[1] - sin * d[0], d[2])
    if shapes[i, 0] == _BOX:
        return _hit_box(lo, ld, (shapes[i, 4], shapes[i, 5], shapes[i, 6]))
    if shapes[i, 0] == _SPHERE:
        return _hit_sphere(lo, ld, shapes[i, 4])
    return _hit_cylinder(lo, ld, shapes[i, 4], shapes[i, 6])


@njit(**OPTIONS)
def _hit_walls(o, d, size):
    """t and face (-x, +x, -y, +y, floor, ceiling) where a ray inside the room leaves it."""
    half_x, half_y = 0.5 * size[0], 0.5 * size[1]
    t = ((half_x if d[0] > 0 else -half_x) - o[0]) / _away_from_zero(d[0])
    best, face = t, 1 if d[0] > 0 else 0
    t = ((half_y if d[1] > 0 else -half_y) - o[1]) / _away_from_zero(d[1])
    if t < best:
        best, face = t, 3 if d[1] > 0 else 2
    t = ((size[2] if d[2] > 0 else 0.0) - o[2]) / _away_from_zero(d[2])
    if t < best:
        best, face = t, 5 if d[2] > 0 else 4
    return best, face


@njit(**OPTIONS)
def _corner(shapes, i, k, c2w):
    """Camera-frame position of corner k of the box around shape i."""
    lx = shapes[i, 4] if k & 1 else -shapes[i, 4]
    ly = shapes[i, 5] if k & 2 else -shapes[i, 5]
    x = shapes[i, 1] + shapes[i, 7] * lx - shapes[i, 8] * ly - c2w[0, 3]
    y = shapes[i, 2] + shapes[i, 8] * lx + shapes[i, 7] * ly - c2w[1, 3]
    z = shapes[i, 3] + (shapes[i, 6] if k & 4 else -shapes[i, 6]) - c2w[2, 3]
    return (
        c2w[0, 0] * x + c2w[1, 0] * y + c2w[2, 0] * z,
        c2w[0, 1] * x + c2w[1, 1] * y + c2w[2, 1] * z,
        c2w[0, 2] * x + c2w[1, 2] * y + c2w[2, 2] * z,
    )


@njit(**OPTIONS)
def visible(shapes, c2w, intrinsics):
    """Shapes in front of the camera by nearest z, and their bounds (nearest z, u0, u1, v0, v1)."""
    count = shapes.shape[0]
    bounds = np.empty((count, 5))
    for i in range(count):
        nearest, u0, u1, v0, v1 = np.inf, np.inf, -np.inf, np.inf, -np.inf
        farthest = -np.inf
        for k in range(8):
            x, y, z = _corner(shapes, i, k, c2w)
            nearest, farthest = min(nearest, z), max(farthest, z)
            if z > NEAR:
                u = intrinsics[0] * x / z + intrinsics[2]
                v = intrinsics[1] * y / z + intrinsics[3]
                u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
        if farthest <= NEAR:
            nearest = np.inf
        elif nearest <= NEAR:
            u0, u1, v0, v1 = -np.inf, np.inf, -np.inf, np.inf
        bounds[i, 0] = nearest
        bounds[i, 1], bounds[i, 2], bounds[i, 3], bounds[i, 4] = u0, u1, v0, v1
    order = np.argsort(bounds[:, 0])
    shown = 0
    while shown < count and bounds[order[shown], 0] < np.inf:
        shown += 1
    return order[:shown], bounds


@njit(**OPTIONS)
def _candidates(order, count, bounds, column, row, extent, found):
    """Fill `found` with those of the first `count` shapes of `order` that may touch a square.

    The square of `extent` pixels begins at (column, row). Returns how many were found.
    """
    n = 0
    for k in range(count):
        i = order[k]
        outside = bounds[i, 1] > column + extent or bounds[i, 2] < column
        if not (outside or bounds[i, 3] > row + extent or bounds[i, 4] < row):
            found[n] = i
            n += 1
    return n


@njit(**OPTIONS)
def _direction(c2w, intrinsics, u, v):
    x, y = (u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1]
    return (
        c2w[0, 0] * x + c2w[0, 1] * y + c2w[0, 2],
        c2w[1, 0] * x + c2w[1, 1] * y + c2w[1, 2],
        c2w[2, 0] * x + c2w[2, 1] * y + c2w[2, 2],
    )


@njit(**OPTIONS)
def _nearest(shapes, size, bounds, found, count, o, d):
    """t of the nearest hit, the wall face there, and the shape's index (-1 for a wall)."""
    best, face = _hit_walls(o, d, size)
    index = -1
    for k in range(count):
        i = found[k]
        if bounds[i, 0] > best:
            break
        t = hit(shapes, i, o, d)
        if t < best:
            best, index = t, i
    return best, face, index


@njit(**OPTIONS)
def cast_colors(image, rows, samples, room, floor, c2w, intrinsics, view):
    """Write rows [rows[0], rows[1]) of image (H, W, 3) uint8; rows[0] is a multiple of the tile.

    Each pixel is the mean of samples x samples rays on a regular grid.
    """
    shapes, textures, size, lights = room
    order, bounds = view
    width = image.shape[1]
    in_tile = np.empty(shapes.shape[0], np.int64)
    found = np.empty(shapes.shape[0], np.int64)
    o = (c2w[0, 3], c2w[1, 3], c2w[2, 3])
    spread = 1 / (intrinsics[0] * samples)
    gain = 255.0 / (samples * samples)
    for top in range(rows[0], rows[1], TILE):
        for left in range(0, width, TILE):
            tiled = _candidates(order, len(order), bounds, left, top, TILE, in_tile)
            for row in range(top, min(top + TILE, rows[1])):
                for column in range(left, min(left + TILE, width)):
                    count = _candidates(in_tile, tiled, bounds, column, row, 1, found)
                    r = g = b = 0.0
                    for k in range(samples * samples):
                        u = column + (k % samples + 0.5) / samples
                        v = row + (k // samples + 0.5) / samples
                        d = _direction(c2w, intrinsics, u, v)
                        t, face, i = _nearest(shapes, size, bounds, found, count, o, d)
                        color = shade(
                            shapes, textures, size, lights, floor, o, d, t, face, i, t * spread
                        )
                        r, g, b = r + color[0], g + color[1], b + color[2]
                    image[row, column, 0] = int(gain * r + 0.5)
                    image[row, column, 1] = int(gain * g + 0.5)
                    image[row, column, 2] = int(gain * b + 0.5)


@njit(**OPTIONS)
def cast_depths(depth, rows, room, c2w, intrinsics, view):
    """Write rows [rows[0], rows[1]) of depth (H, W) float32: z of the ray through pixel centres."""
    shapes, _, size, _ = room
    order, bounds = view
    in_tile = np.empty(shapes.shape[0], np.int64)
    found = np.empty(shapes.shape[0], np.int64)
    o = (c2w[0, 3], c2w[1, 3], c2w[2, 3])
    for top in range(rows[0], rows[1], TILE):
        for left in range(0, depth.shape[1], TILE):
            tiled = _candidates(order, len(order), bounds, left, top, TILE, in_tile)
            for row in range(top, min(top + TILE, rows[1])):
                for column in range(left, min(left + TILE, depth.shape[1])):
                    count = _candidates(in_tile, tiled, bounds, column, row, 1, found)
                    d = _direction(c2w, intrinsics, column + 0.5, row + 0.5)
                    depth[row, column] = _nearest(shapes, size, bounds, found, count, o, d)[0]

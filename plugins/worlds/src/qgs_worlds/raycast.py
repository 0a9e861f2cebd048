"""Which surface each ray of an image meets first: shapes by the rows and columns they cover."""

import numpy as np
from numba import njit

from qgs_worlds import rows as r
from qgs_worlds.intervals import (
    box,
    capsule,
    ellipsoid,
    frustum,
    less,
    local,
    local_point,
    nearest,
    relief,
    torus,
)
from qgs_worlds.kernels import BORROWING
from qgs_worlds.rooms.intersections import NONE, ZERO
from qgs_worlds.rooms.raycast import covered, ray_basis, row_base, span
from qgs_worlds.rooms.textures import INNER, OPTIONS

SKY = -1  # part p of shape i has code 8 i + p


@njit(**INNER)
def _corners(shapes, i, c2w, corners):
    """Write the camera-frame positions (8, 3) of the corners of the box around shape i."""
    axes = np.empty((3, 3))
    middle = np.empty(3)
    for a in range(3):
        middle[a] = 0.0
        for k in range(3):
            middle[a] += c2w[k, a] * (shapes[i, r.CENTER + k] - c2w[k, 3])
    for j in range(3):
        # the matrix is a rotation after division by the half sizes: its rows give the axes
        size = shapes[i, r.HALF + j] * shapes[i, r.HALF + j] * shapes[i, r.EXTENT + j]
        for a in range(3):
            axes[j, a] = 0.0
            for k in range(3):
                axes[j, a] += c2w[k, a] * shapes[i, r.MATRIX + 3 * j + k] * size
    for corner in range(8):
        for a in range(3):
            corners[corner, a] = middle[a]
            for j in range(3):
                corners[corner, a] += axes[j, a] if corner >> j & 1 else -axes[j, a]


@njit(**BORROWING)
def _ray(o, base, step, along):
    """The ray at column `along` of a row: its point nearest to the origin, direction, t there."""
    x, y = base[0] + along * step[0], base[1] + along * step[1]
    d = (x, y, base[2] + along * step[2])
    p, t = nearest(o, d)
    return p, d, t


@njit(**BORROWING)
def _store(spans, k, found, t):
    near, far, entry, leave = found
    spans[0, k], spans[1, k], spans[2, k], spans[3, k] = near + t, far + t, entry, leave


@njit(**BORROWING)
def _inside_row(kind, extra, heights, steps, o, base, step, spans):
    """Write `spans` (4, R): entries, exits and their faces, for the rays of a row.

    A loop for each kind, as LLVM vectorises loops without branches.
    """
    if kind == r.ELLIPSOID:
        for k in range(steps.shape[0]):
            p, d, t = _ray(o, base, step, steps[k])
            _store(spans, k, ellipsoid(p, d), t)
    elif kind == r.BOX:
        for k in range(steps.shape[0]):
            p, d, t = _ray(o, base, step, steps[k])
            _store(spans, k, box(p, d), t)
    elif kind == r.FRUSTUM:
        for k in range(steps.shape[0]):
            p, d, t = _ray(o, base, step, steps[k])
            _store(spans, k, frustum(p, d, extra), t)
    elif kind == r.CAPSULE:
        for k in range(steps.shape[0]):
            p, d, t = _ray(o, base, step, steps[k])
            _store(spans, k, capsule(p, d, extra), t)
    else:
        for k in range(steps.shape[0]):
            p, d, t = _ray(o, base, step, steps[k])
            if kind == r.TORUS:
                _store(spans, k, torus(p, d, extra, -t), t)
            else:
                _store(spans, k, relief(p, d, heights, -t), t)


@njit(**BORROWING)
def _closest(t, code, own, first, second):
    """Keep what is nearer: a shape by the intervals of its primitives (4, R), or what was there."""
    for k in range(t.shape[0]):
        near, face = less(
            first[0, k], first[1, k], first[2, k], second[0, k], second[1, k], second[3, k]
        )
        closer = near < t[k]
        t[k] = near if closer else t[k]
        code[k] = own + face if closer else code[k]


@njit(**INNER)
def _trace_shape(t, code, top, samples, shapes, heights, i, o, rays, steps, area, scratch):
    """Let shape i cover what lies behind it in an area of the samples."""
    above, below, first, last = area
    step = (np.float32(rays[0, 1]), np.float32(rays[1, 1]), np.float32(rays[2, 1]))
    own, along = np.float32(8 * i), steps[first:last]
    parts = 2 if shapes[i, r.PRIMITIVE_FIELDS] >= ZERO else 1
    spans = scratch[:, :, : last - first]
    spans[1, 0], spans[1, 1], spans[1, 3] = NONE, -NONE, ZERO
    for row in range(above, below):
        base = row_base(rays, top + (row + 0.5) / samples)
        for part in range(parts):
            p = part * r.PRIMITIVE_FIELDS
            lo = local_point(shapes, i, p, o[0], o[1], o[2])
            ls = local(shapes, i, p, step[0], step[1], step[2])
            lb = local(shapes, i, p, base[0], base[1], base[2])
            kind, extra = int(shapes[i, p]), shapes[i, p + 1]
            field = heights[int(extra) if kind == r.HEIGHT else 0]
            _inside_row(kind, extra, field, along, lo, lb, ls, spans[part])
        _closest(t[row, first:last], code[row, first:last], own, spans[0], spans[1])


@njit(**OPTIONS)
def trace(rows, columns, top, samples, shapes, heights, c2w, intrinsics):
    """t and code (R, C) float32 of rays from pixel row `top` on, at pixel sub-centres."""
    t = np.full((rows * samples, columns * samples), NONE, np.float32)
    code = np.full((rows * samples, columns * samples), np.float32(SKY), np.float32)
    rays = ray_basis(c2w, intrinsics)
    steps = np.empty(columns * samples, np.float32)
    for j in range(columns * samples):
        steps[j] = (j + 0.5) / samples
    o = (np.float32(c2w[0, 3]), np.float32(c2w[1, 3]), np.float32(c2w[2, 3]))
    corners, points = np.empty((8, 3)), np.empty((20, 3))
    scratch = np.empty((2, 4, columns * samples), np.float32)
    for i in range(shapes.shape[0]):
        _corners(shapes, i, c2w, corners)
        u0, u1, v0, v1 = covered(corners, points, intrinsics)
        first, last = span(u0, u1, samples, 0.0, columns * samples)
        above, below = span(v0, v1, samples, top, rows * samples)
        if first < last and above < below:
            area = (above, below, first, last)
            _trace_shape(t, code, top, samples, shapes, heights, i, o, rays, steps, area, scratch)
    return t, code, rays

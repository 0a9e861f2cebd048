"""Normals and texture coordinates of points on primitives."""

import math

import numpy as np
from numba import njit

from qgs_worlds.caster import tables as s
from qgs_worlds.caster.intervals import height_at, local_point
from qgs_worlds.caster.kernels import INNER
from qgs_worlds.caster.vectors import dot, longest, times, triple, unit


@njit(**INNER)
def on_axis(axis, p, unit):
    """Return the normal of a box's face across an axis, the position on it, and its number."""
    x, y, z = p
    if axis == 0:
        return (math.copysign(1.0, x), 0.0, 0.0), y * unit[1], z * unit[2], (1 if x > 0 else 0)
    if axis == 1:
        return (0.0, math.copysign(1.0, y), 0.0), x * unit[0], z * unit[2], (3 if y > 0 else 2)
    return (0.0, 0.0, math.copysign(1.0, z)), x * unit[0], y * unit[1], (5 if z > 0 else 4)


@njit(**INNER)
def _on_relief(field, p, unit):
    x, y, _ = p
    step = np.float32(2.0 / (field.shape[0] - 1))
    slope_x = height_at(field, x + step, y) - height_at(field, x - step, y)
    slope_y = height_at(field, x, y + step) - height_at(field, x, y - step)
    normal = (-slope_x / (2 * step), -slope_y / (2 * step), 1.0)
    return normal, x * unit[0], y * unit[1], 0


@njit(**INNER)
def _on_primitive(primitive, heights, face, p):
    """Return what `on_axis` does for a primitive of any kind, at a point and a face of it."""
    kind = primitive.kind
    extra = primitive.extra
    unit = triple(primitive.unit)
    x, y, z = p
    if kind == s.BOX:
        return on_axis(face, p, unit)
    if kind == s.ELLIPSOID:
        _, u, v, _ = on_axis(longest((x / unit[0], y / unit[1], z / unit[2])), p, unit)
        return p, u, v, 0
    if kind == s.HEIGHT:
        if face == 1:
            return on_axis(longest(p), p, unit)
        return _on_relief(heights[int(extra)], p, unit)
    across = math.sqrt(x * x + y * y)
    angle = math.atan2(y, x)
    if kind == s.TORUS:
        ring = 1.0 - extra
        w = (across - ring) / max(across, 1e-6)
        v = math.atan2(z, across - ring) * extra * unit[0]
        return (w * x, w * y, z), angle * ring * unit[0], v, 0
    if kind == s.CAPSULE:
        from_segment = (x, y, z - min(max(z, -extra), extra))
        return from_segment, angle * unit[0], z * unit[2], 0
    if face == 1:
        normal, u, v, _ = on_axis(2, p, unit)
        return normal, u, v, 1
    return (x, y, 0.5 * (1 - extra) * across), angle * unit[0], z * unit[2], 0


@njit(**INNER)
def to_world(primitive, n):
    """Return a normal in the frame of a primitive in that of the world, of any length."""
    axes = primitive.axes
    return dot(axes[:, 0], n), dot(axes[:, 1], n), dot(axes[:, 2], n)


@njit(**INNER)
def surface(shape, heights, part, place):
    """Return the index of the texture, world normal and texture coordinates of a point."""
    cut = part >= 3
    primitive = shape.cut if cut else shape.body
    face = part - 3 if cut else part
    p = (np.float32(place[0]), np.float32(place[1]), np.float32(place[2]))
    n, u, v, side = _on_primitive(primitive, heights, face, local_point(primitive, p))
    normal = unit(times(-1.0 if cut else 1.0, to_world(primitive, n)))
    row = shape.cut_texture if cut else shape.texture + min(side, shape.faces - 1)
    scale = 1.0 / shape.scale
    return row, normal, u * scale, v * scale

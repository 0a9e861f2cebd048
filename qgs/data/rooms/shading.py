"""The colour of a surface point: texture times light."""

from __future__ import annotations

import math

from numba import njit

from qgs.data.rooms import shapes as s
from qgs.data.rooms.textures import OPTIONS, mixture

_BOX, _SPHERE = s.BOX, s.SPHERE
_FLAT = 0.03  # what lies on the floor and is lower than this shows the floor's shadows


@njit(**OPTIONS)
def _on_wall(x, y, z, size, face):
    """Inward normal, position in metres and position in [-1, 1] on a wall, floor or ceiling."""
    if face < 2:
        q = 2 * z / size[2] - 1
        return (1.0 - 2.0 * face, 0.0, 0.0), y, z, 2 * y / size[1], q
    if face < 4:
        q = 2 * z / size[2] - 1
        return (0.0, 5.0 - 2.0 * face, 0.0), x, z, 2 * x / size[0], q
    return (0.0, 0.0, 9.0 - 2.0 * face), x, y, 2 * x / size[0], 2 * y / size[1]


@njit(**OPTIONS)
def _on_box(x, y, z, h):
    """As `_on_wall`, in the box's own frame."""
    a, b, c = abs(x) / h[0], abs(y) / h[1], abs(z) / h[2]
    if a >= b and a >= c:
        return (math.copysign(1.0, x), 0.0, 0.0), y, z, y / h[1], z / h[2]
    if b >= c:
        return (0.0, math.copysign(1.0, y), 0.0), x, z, x / h[0], z / h[2]
    return (0.0, 0.0, math.copysign(1.0, z)), x, y, x / h[0], y / h[1]


@njit(**OPTIONS)
def _on_round(x, y, z, h, kind):
    """As `_on_box`, for spheres and cylinders."""
    angle = math.atan2(y, x)
    u, p = angle * h[0], angle / math.pi
    if kind == _SPHERE:
        return (x / h[0], y / h[0], z / h[0]), u, z, p, z / h[0]
    if abs(z) > 0.9999 * h[2]:
        return (0.0, 0.0, math.copysign(1.0, z)), x, y, x / h[0], y / h[0]
    return (x / h[0], y / h[0], 0.0), u, z, p, z / h[2]


@njit(**OPTIONS)
def _lit(point, normal, lights):
    """Light that arrives: a bright ceiling above, a lamp, a window."""
    light = 0.42 + 0.12 * normal[2]
    for k in range(lights.shape[0]):
        x, y, z = lights[k, 0] - point[0], lights[k, 1] - point[1], lights[k, 2] - point[2]
        square = x * x + y * y + z * z
        cosine = (normal[0] * x + normal[1] * y + normal[2] * z) / math.sqrt(square)
        light += lights[k, 3] * max(cosine, 0.0) / (1 + 0.12 * square)
    return light


@njit(**OPTIONS)
def _edge(distance):
    return 1 - 0.30 * math.exp(-5.0 * distance)


@njit(**OPTIONS)
def _corners(x, y, z, size, face):
    """Darkening of walls towards the room's edges."""
    a = 1.0 if face < 2 else _edge(0.5 * size[0] - abs(x))
    b = 1.0 if face == 2 or face == 3 else _edge(0.5 * size[1] - abs(y))
    c = 1.0 if face >= 4 else _edge(z) * _edge(size[2] - z)
    return a * b * c


@njit(**OPTIONS)
def _floor_light(floor, x, y, size):
    """Bilinear look-up in the floor's map of shadows, (L, L) over the whole floor."""
    last = floor.shape[0] - 1
    a = min(max((x / size[0] + 0.5) * last, 0.0), last - 1e-6)
    b = min(max((y / size[1] + 0.5) * last, 0.0), last - 1e-6)
    i, j = int(a), int(b)
    a, b = a - i, b - j
    low = floor[i, j] * (1 - b) + floor[i, j + 1] * b
    high = floor[i + 1, j] * (1 - b) + floor[i + 1, j + 1] * b
    return low * (1 - a) + high * a


@njit(**OPTIONS)
def _film(value):
    """A contrast curve from [0, inf) to [0, 1]."""
    value = min(value, 1.0)
    return value * value * (3 - 2 * value)


@njit(**OPTIONS)
def shade(shapes, textures, size, lights, floor, o, d, t, face, index, footprint):
    """RGB in [0, 1] of the hit at o + t d, on wall `face` or, if index >= 0, on that shape."""
    x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
    if index < 0:
        normal, u, v, p, q = _on_wall(x, y, z, size, face)
        texture = face
        shadow = _corners(x, y, z, size, face)
        if face == 4:
            shadow *= _floor_light(floor, x, y, size)
    else:
        cos, sin = shapes[index, 7], shapes[index, 8]
        h = (shapes[index, 4], shapes[index, 5], shapes[index, 6])
        lx, ly, lz = x - shapes[index, 1], y - shapes[index, 2], z - shapes[index, 3]
        lx, ly = cos * lx + sin * ly, cos * ly - sin * lx
        if shapes[index, 0] == _BOX:
            n, u, v, p, q = _on_box(lx, ly, lz, h)
        else:
            n, u, v, p, q = _on_round(lx, ly, lz, h, shapes[index, 0])
        normal = (cos * n[0] - sin * n[1], sin * n[0] + cos * n[1], n[2])
        texture = int(shapes[index, 9])
        flat = z < _FLAT and normal[2] > 0.5
        shadow = _floor_light(floor, x, y, size) if flat else 1 - 0.35 * math.exp(-6 * z)
    m, k = mixture(
        int(textures[texture, 0]),
        textures[texture, 1],
        int(textures[texture, 2]),
        u,
        v,
        p,
        q,
        footprint,
    )
    light = _lit((x, y, z), normal, lights) * shadow
    light = light + (1 - light) * textures[texture, 3]
    a, b, c = (1 - m) * (1 - k), m * (1 - k), k
    return (
        min(
            light
            * (a * textures[texture, 4] + b * textures[texture, 7] + c * textures[texture, 10]),
            1.0,
        ),
        min(
            light
            * (a * textures[texture, 5] + b * textures[texture, 8] + c * textures[texture, 11]),
            1.0,
        ),
        min(
            light
            * (a * textures[texture, 6] + b * textures[texture, 9] + c * textures[texture, 12]),
            1.0,
        ),
    )

"""The floor's map of shadows, made once per room."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from qgs.data.rooms.intersections import hit
from qgs.data.rooms.textures import INNER, OPTIONS

_SHADOW = 0.36  # how much of the light the lamp's shadow takes
_UNDER = np.float32(-1)
_UP = (np.float32(0), np.float32(0), np.float32(10))


@njit(**INNER)
def _extent(shapes, i):
    """Half extents of shape i's bounding box along the world's x and y."""
    cos, sin = abs(shapes[i, 7]), abs(shapes[i, 8])
    return cos * shapes[i, 4] + sin * shapes[i, 5], sin * shapes[i, 4] + cos * shapes[i, 5]


@njit(**INNER)
def _range(low, high, extent, cells):
    """Indices of the map's cells between two world coordinates."""
    first = math.floor((low / extent + 0.5) * (cells - 1))
    last = math.ceil((high / extent + 0.5) * (cells - 1)) + 1
    return max(first, 0), min(last, cells)


@njit(**INNER)
def _darken(darkness, shapes, s, size, lamp):
    """Add the shadow that shape s throws from the lamp, and the dimness right below it."""
    cells = darkness.shape[0]
    bottom, top = shapes[s, 3] - shapes[s, 6], shapes[s, 3] + shapes[s, 6]
    if bottom > 1.2 or top < 0.03 or top > lamp[2] - 0.2:
        return
    ex, ey = _extent(shapes, s)
    reach = lamp[2] / (lamp[2] - top)
    x0 = min(shapes[s, 1] - ex, lamp[0] + (shapes[s, 1] - ex - lamp[0]) * reach)
    x1 = max(shapes[s, 1] + ex, lamp[0] + (shapes[s, 1] + ex - lamp[0]) * reach)
    y0 = min(shapes[s, 2] - ey, lamp[1] + (shapes[s, 2] - ey - lamp[1]) * reach)
    y1 = max(shapes[s, 2] + ey, lamp[1] + (shapes[s, 2] + ey - lamp[1]) * reach)
    i0, i1 = _range(x0, x1, size[0], cells)
    j0, j1 = _range(y0, y1, size[1], cells)
    source = (np.float32(lamp[0]), np.float32(lamp[1]), np.float32(lamp[2]))
    below = 0.55 * math.exp(-3 * bottom)
    for i in range(i0, i1):
        x = (i / (cells - 1) - 0.5) * size[0]
        for j in range(j0, j1):
            y = (j / (cells - 1) - 0.5) * size[1]
            dark = 0.0
            under = (np.float32(x), np.float32(y), _UNDER)
            if hit(shapes, s, under, _UP) < 1:
                dark = below
            ray = (np.float32(x - lamp[0]), np.float32(y - lamp[1]), np.float32(-lamp[2]))
            if hit(shapes, s, source, ray) < 1:
                dark = max(dark, _SHADOW)
            darkness[i, j] = max(darkness[i, j], dark)


@njit(**INNER)
def _blurred(values):
    """Mean over 3 x 3 cells."""
    last = values.shape[0] - 1
    result = np.empty(values.shape)
    for i in range(values.shape[0]):
        for j in range(values.shape[0]):
            total = 0.0
            for a in range(-1, 2):
                for b in range(-1, 2):
                    total += values[min(max(i + a, 0), last), min(max(j + b, 0), last)]
            result[i, j] = total / 9
    return result


@njit(**OPTIONS)
def floor_shadows(shapes, size, lamp, cells):
    """(cells, cells) factor of the light that reaches the floor, indexed by x, then y."""
    darkness = np.zeros((cells, cells))
    for i in range(shapes.shape[0]):
        _darken(darkness, shapes, i, size, lamp)
    return 1 - _blurred(_blurred(darkness))

"""Ambient occlusion: how much of the sky or the walls a point sees, by boxes around shapes."""

import math

import numpy as np
from numba import njit

from qgs_worlds.caster.intervals import ZERO, hollow, local
from qgs_worlds.caster.kernels import INNER, OPTIONS, REDUCING
from qgs_worlds.caster.vectors import dot, minus

# Of a box: matrix, centre in its frame, extents, units and the number of its shape.
_FIELDS = 19


@njit(**OPTIONS)
def surroundings(shapes):
    """Return what `visible` keeps for points that follow each other: all boxes; those near.

    Boxes (19, S), a field a row, so that loops over them are vectorised. Then the place, the number
    of boxes near it, and the square of the distance up to which they are enough.
    """
    boxes = np.empty((_FIELDS, shapes.shape[0]), np.float32)
    for i in range(shapes.shape[0]):
        body = shapes[i].body
        center = local(body, body.center)
        for k in range(3):
            for axis in range(3):
                boxes[3 * k + axis, i] = body.axes[k, axis]
            boxes[9 + k, i] = center[k]
            boxes[12 + k, i] = body.extent[k]
            boxes[15 + k, i] = body.unit[k]
        boxes[18, i] = i
    return boxes, np.empty_like(boxes), np.full(5, np.inf)


@njit(**INNER)
def _find(shapes, around, p, reach, slack):
    """Keep the boxes near to a place, without those of hollow shapes, which do not fill them."""
    boxes, near, place = around
    for k in range(3):
        place[k] = p[k]
    place[4] = slack * slack
    count = 0
    reach = np.float32(1.6 * reach + slack)
    for i in range(shapes.shape[0]):
        away = minus(shapes[i].body.center, p)
        size = shapes[i].radius + reach
        if dot(away, away) < size * size and not hollow(shapes[i]):
            for k in range(_FIELDS):
                near[k, count] = boxes[k, i]
            count += 1
    place[3] = count


@njit(**REDUCING)
def visible(shapes, around, own, point, normal, strength, reach, footprint):
    """Return how much ambient light reaches a point: a distance field at two heights above it.

    As Evans 2006, "Fast approximations for global illumination on dynamic scenes". own: the shape
    that the point is on. footprint: metres between pixels there.
    """
    x = np.float32(point[0])
    y = np.float32(point[1])
    z = np.float32(point[2])
    nx = np.float32(normal[0])
    ny = np.float32(normal[1])
    nz = np.float32(normal[2])
    low = np.float32(0.25 * reach)
    high = np.float32(0.8 * reach)
    _, near, place = around
    moved = minus(place, point)
    if place[4] == np.inf or dot(moved, moved) > place[4]:
        _find(shapes, around, (x, y, z), reach, 0.3 * reach + 4 * footprint)
    # float32 as the boxes are, so that the loop stays narrow
    me = np.float32(own)
    first = low * low
    second = high * high
    # no branches and no stores, so that LLVM vectorises it
    for i in range(int(place[3])):
        under = over = ZERO
        for axis in range(3):
            m = 3 * axis
            a = near[m, i] * x + near[m + 1, i] * y + near[m + 2, i] * z - near[9 + axis, i]
            b = near[m, i] * nx + near[m + 1, i] * ny + near[m + 2, i] * nz
            below = max(abs(a + low * b) - near[12 + axis, i], ZERO) * near[15 + axis, i]
            above = max(abs(a + high * b) - near[12 + axis, i], ZERO) * near[15 + axis, i]
            under += below * below
            over += above * above
        other = near[18, i] != me
        first = min(first, under if other else first)
        second = min(second, over if other else second)
    # hidden by as much as the nearest shape is nearer than the height itself
    hidden = max(1 - math.sqrt(first) / low, ZERO) + max(1 - math.sqrt(second) / high, ZERO)
    return 1.0 - 0.5 * strength * hidden

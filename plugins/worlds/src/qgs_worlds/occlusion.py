"""Ambient occlusion: how much of the sky or the walls a point sees, by boxes around shapes."""

import math

import numpy as np
from numba import njit

from qgs_worlds import rows as r
from qgs_worlds.intervals import hollow, local
from qgs_worlds.kernels import BORROWING, REDUCING
from qgs_worlds.rooms.intersections import ZERO
from qgs_worlds.rooms.textures import INNER


@njit(**INNER)
def surroundings(shapes):
    """What `visible` keeps for points that follow each other: all boxes; those near to a place.

    Boxes (19, S): matrices, centres in their frames, extents, half sizes and shapes. Then the
    place, the number of boxes near it, and the square of the distance up to which they are enough.
    """
    boxes = np.empty((19, shapes.shape[0]), np.float32)
    for i in range(shapes.shape[0]):
        x, y, z = shapes[i, r.CENTER], shapes[i, r.CENTER + 1], shapes[i, r.CENTER + 2]
        center = local(shapes, i, 0, x, y, z)
        for k in range(9):
            boxes[k, i] = shapes[i, r.MATRIX + k]
        for k in range(3):
            boxes[9 + k, i] = center[k]
            boxes[12 + k, i] = shapes[i, r.EXTENT + k]
            boxes[15 + k, i] = shapes[i, r.HALF + k]
        boxes[18, i] = i
    return boxes, np.empty_like(boxes), np.full(5, np.inf)


@njit(**BORROWING)
def _find(shapes, around, x, y, z, reach, slack):
    """Keep the boxes near to a place, without those of hollow shapes, which do not fill them."""
    boxes, near, place = around
    place[0], place[1], place[2], place[4] = x, y, z, slack * slack
    count, reach = 0, np.float32(1.6 * reach + slack)
    for i in range(shapes.shape[0]):
        a, b, c = shapes[i, r.SPHERE] - x, shapes[i, r.SPHERE + 1] - y, shapes[i, r.SPHERE + 2] - z
        size = shapes[i, r.SPHERE + 3] + reach
        if a * a + b * b + c * c < size * size and not hollow(shapes, i):
            for k in range(19):
                near[k, count] = boxes[k, i]
            count += 1
    place[3] = count


@njit(**REDUCING)
def visible(shapes, around, own, point, normal, strength, reach, footprint):
    """How much of the ambient light reaches a point: a distance field at two heights above it.

    As Evans 2006, "Fast approximations for global illumination on dynamic scenes". own: the shape
    that the point is on. footprint: metres between pixels there.
    """
    x, y, z = np.float32(point[0]), np.float32(point[1]), np.float32(point[2])
    nx, ny, nz = np.float32(normal[0]), np.float32(normal[1]), np.float32(normal[2])
    low, high = np.float32(0.25 * reach), np.float32(0.8 * reach)
    _, near, place = around
    a, b, c = place[0] - point[0], place[1] - point[1], place[2] - point[2]
    if place[4] == np.inf or a * a + b * b + c * c > place[4]:
        _find(shapes, around, x, y, z, reach, 0.3 * reach + 4 * footprint)
    me, first, second = np.float32(own), low * low, high * high
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
        under, over = (under if other else first), (over if other else second)
        first, second = min(first, under), min(second, over)
    hidden = max(1 - math.sqrt(first) / low, ZERO) + max(1 - math.sqrt(second) / high, ZERO)
    return 1.0 - 0.5 * strength * hidden

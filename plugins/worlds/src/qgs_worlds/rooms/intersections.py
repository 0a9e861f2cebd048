"""Where a ray o + t d meets a shape: slabs, spheres and upright cylinders, entry points only.

All numbers are float32, constants too: a wider one would widen the loops that LLVM vectorises.
"""

import math

import numpy as np
from numba import njit

from qgs_worlds.rooms import shapes as s
from qgs_worlds.rooms.textures import INNER, OPTIONS

NEAR = np.float32(0.02)
NONE = np.float32(np.inf)
TINY = np.float32(1e-9)
ZERO, ONE = np.float32(0), np.float32(1)


@njit(**INNER)
def reciprocal(x):
    """1 / x, large where x is 0."""
    return ONE / (x if abs(x) > TINY else TINY)


@njit(**INNER)
def slab(o, inverse, h):
    """Where a ray is between -h and h along one axis: entry and exit; inverse is 1 / d."""
    a, b = (-h - o) * inverse, (h - o) * inverse
    return min(a, b), max(a, b)


@njit(**INNER)
def hit_sphere(o, d, radius):
    """Entry into the sphere of `radius` around the origin."""
    inverse = ONE / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    middle = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) * inverse
    x, y, z = o[0] + middle * d[0], o[1] + middle * d[1], o[2] + middle * d[2]
    inside = radius * radius - (x * x + y * y + z * z)
    t = middle - math.sqrt(max(inside, ZERO) * inverse)
    return t if (inside > ZERO) & (t > NEAR) else NONE


@njit(**INNER)
def hit_cylinder(o, d, radius, half):
    """Entry into an upright cylinder around the origin, and where it would enter between caps."""
    low, high = slab(o[2], reciprocal(d[2]), half)
    inverse = reciprocal(d[0] * d[0] + d[1] * d[1])
    middle = -(o[0] * d[0] + o[1] * d[1]) * inverse
    x, y = o[0] + middle * d[0], o[1] + middle * d[1]
    inside = radius * radius - (x * x + y * y)
    root = math.sqrt(max(inside, ZERO) * inverse)
    near, far = max(low, middle - root), min(high, middle + root)
    return near if (inside > ZERO) & (near > NEAR) & (near <= far) else NONE, low


@njit(**INNER)
def hit_box(o, d, h):
    """Entry into a box around the origin, and where it would enter between x and y sides."""
    near_x, far_x = slab(o[0], reciprocal(d[0]), h[0])
    near_y, far_y = slab(o[1], reciprocal(d[1]), h[1])
    near_z, far_z = slab(o[2], reciprocal(d[2]), h[2])
    near, far = max(near_x, near_y, near_z), min(far_x, far_y, far_z)
    return near if (near > NEAR) & (near <= far) else NONE, near_x, near_y


@njit(**INNER)
def local(shapes, i, x, y, z):
    """A direction turned into the frame of shape i."""
    cos, sin = shapes[i, 7], shapes[i, 8]
    return cos * x + sin * y, cos * y - sin * x, z


@njit(**INNER)
def local_point(shapes, i, x, y, z):
    """A point in the frame of shape i."""
    return local(shapes, i, x - shapes[i, 1], y - shapes[i, 2], z - shapes[i, 3])


@njit(**OPTIONS)
def hit(shapes, i, o, d):
    """t at which the ray o + t d enters shape i, or inf."""
    lo = local_point(shapes, i, o[0], o[1], o[2])
    ld = local(shapes, i, d[0], d[1], d[2])
    if shapes[i, 0] == s.BOX:
        return hit_box(lo, ld, (shapes[i, 4], shapes[i, 5], shapes[i, 6]))[0]
    if shapes[i, 0] == s.SPHERE:
        return hit_sphere(lo, ld, shapes[i, 4])
    return hit_cylinder(lo, ld, shapes[i, 4], shapes[i, 6])[0]

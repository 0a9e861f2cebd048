"""Where a ray o + t d is inside a primitive: entry, exit, and by which face of each.

Numbers are float32, in the primitive's own frame. o is the point of the ray nearest to the
frame's origin (`nearest`), as small differences of large numbers would lose thin things far away.
A ray that misses enters at inf and leaves at -inf.
"""

import math

import numpy as np
from numba import njit

from qgs_worlds import rows as r
from qgs_worlds.kernels import BORROWING
from qgs_worlds.rooms.intersections import NONE, ONE, TINY, ZERO, reciprocal, slab
from qgs_worlds.rooms.textures import OPTIONS

NEAR = np.float32(0.01)
_HALF, _TWO = np.float32(0.5), np.float32(2)
_STEPS, _TOUCH = 48, np.float32(2e-4)  # of the search for a torus


@njit(**BORROWING)
def nearest(o, d):
    """The point of a ray that is nearest to the origin, and its t."""
    t = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    return (o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]), t


@njit(**BORROWING)
def ellipsoid(o, d):
    """The unit sphere."""
    inside = ONE - (o[0] * o[0] + o[1] * o[1] + o[2] * o[2])
    root = math.sqrt(max(inside, ZERO) / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]))
    met = inside > ZERO
    return (-root if met else NONE), (root if met else -NONE), ZERO, ZERO


@njit(**BORROWING)
def box(o, d):
    """The cube; faces are numbered by axis."""
    near_x, far_x = slab(o[0], reciprocal(d[0]), ONE)
    near_y, far_y = slab(o[1], reciprocal(d[1]), ONE)
    near_z, far_z = slab(o[2], reciprocal(d[2]), ONE)
    near, far = max(near_x, near_y, near_z), min(far_x, far_y, far_z)
    entry = ZERO if near == near_x else (ONE if near == near_y else _TWO)
    leave = ZERO if far == far_x else (ONE if far == far_y else _TWO)
    return near, far, entry, leave


@njit(**BORROWING)
def frustum(o, d, top):
    """Radius 1 at z = -1, `top` <= 1 at z = 1. Face 0 is the side, 1 a cap."""
    low, high = slab(o[2], reciprocal(d[2]), ONE)
    slope = _HALF * (top - ONE)
    radius, change = _HALF * (top + ONE) + slope * o[2], slope * d[2]
    a = d[0] * d[0] + d[1] * d[1] - change * change
    b = o[0] * d[0] + o[1] * d[1] - change * radius
    c = o[0] * o[0] + o[1] * o[1] - radius * radius
    a = a if abs(a) > TINY else TINY
    square = b * b - a * c
    root = math.sqrt(max(square, ZERO))
    # roots without a difference of like numbers
    q = -(b + math.copysign(root, b))
    first, second = q / a, c / (q if abs(q) > TINY else TINY)
    first, second = min(first, second), max(first, second)
    # a steep ray is inside both halves of the double cone: on the side below the tip
    down = d[2] < ZERO
    side_near = first if a > ZERO else (second if down else -NONE)
    side_far = second if a > ZERO else (NONE if down else first)
    near, far = max(low, side_near), min(high, side_far)
    met = square > ZERO
    return (
        (near if met else NONE),
        (far if met else -NONE),
        (ONE if near == low else ZERO),
        (ONE if far == high else ZERO),
    )


@njit(**BORROWING)
def capsule(o, d, half):
    """Points up to 1 from the segment between z = -half and half."""
    low, high = slab(o[2], reciprocal(d[2]), half)
    flat = reciprocal(d[0] * d[0] + d[1] * d[1])
    middle = -(o[0] * d[0] + o[1] * d[1]) * flat
    x, y = o[0] + middle * d[0], o[1] + middle * d[1]
    inside = ONE - (x * x + y * y)
    root = math.sqrt(max(inside, ZERO) * flat)
    near, far = max(low, middle - root), min(high, middle + root)
    met = (inside > ZERO) & (near <= far)
    near, far = (near if met else NONE), (far if met else -NONE)
    for end in (-half, half):
        p, shift = nearest((o[0], o[1], o[2] - end), d)
        first, last, _, _ = ellipsoid(p, d)
        near, far = min(near, first + shift), max(far, last + shift)
    return near, far, ZERO, ZERO


@njit(**BORROWING)
def torus(o, d, thickness, start):
    """Outer radius 1, thin radius `thickness`, about z, from `start` on; the exit is the entry."""
    length = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    t, end, _, _ = ellipsoid(o, d)
    low, high = slab(o[2], reciprocal(d[2]), thickness)
    t, end = max(t, low, start), min(end, high)
    ring, step = ONE - thickness, ONE / length
    for _ in range(_STEPS):
        if t > end:
            break
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        across = math.sqrt(x * x + y * y) - ring
        away = math.sqrt(across * across + z * z) - thickness
        if away < _TOUCH:
            return t, t, ZERO, ZERO
        t += away * step
    return NONE, -NONE, ZERO, ZERO


@njit(**BORROWING)
def height_at(heights, x, y):
    """Bilinear height at x, y in [-1, 1]."""
    last = heights.shape[0] - 1
    a = min(max((x + ONE) * _HALF, ZERO), np.float32(0.99999)) * np.float32(last)
    b = min(max((y + ONE) * _HALF, ZERO), np.float32(0.99999)) * np.float32(last)
    i, j = int(a), int(b)
    a, b = a - np.float32(i), b - np.float32(j)
    low = heights[i, j] + b * (heights[i, j + 1] - heights[i, j])
    high = heights[i + 1, j] + b * (heights[i + 1, j + 1] - heights[i + 1, j])
    return low + a * (high - low)


@njit(**BORROWING)
def _above(heights, o, d, t):
    return o[2] + t * d[2] - height_at(heights, o[0] + t * d[0], o[1] + t * d[1])


@njit(**BORROWING)
def _next_line(o, d, t, cells):
    """The t at which a ray crosses the next line between cells along one axis."""
    if abs(d) < TINY:
        return NONE
    place = (o + t * d + ONE) * _HALF * cells
    line = (
        math.floor(place + np.float32(1e-3)) + 1
        if d > ZERO
        else math.ceil(place - np.float32(1e-3)) - 1
    )
    return (np.float32(line) / cells * _TWO - ONE - o) / d


@njit(**BORROWING)
def relief(o, d, heights, start):
    """What is below the height map, in the cube, as `torus`. Face 0 is its top, 1 a side."""
    t, end, _, _ = box(o, d)
    t = max(t, start)
    if t > end:
        return NONE, -NONE, ZERO, ZERO
    cells = np.float32(heights.shape[0] - 1)
    above = _above(heights, o, d, t)
    if above < ZERO:
        return t, t, ONE, ONE
    while t < end:
        line = min(_next_line(o[0], d[0], t, cells), _next_line(o[1], d[1], t, cells))
        line = min(max(line, t + np.float32(1e-6)), end)
        below = _above(heights, o, d, line)
        if below < ZERO:
            for _ in range(3):  # regula falsi: heights along a ray in one cell are a parabola
                middle = t + (line - t) * above / (above - below)
                height = _above(heights, o, d, middle)
                if height < ZERO:
                    line, below = middle, height
                else:
                    t, above = middle, height
            t += (line - t) * above / (above - below)
            return t, t, ZERO, ZERO
        t, above = line, below
    return NONE, -NONE, ZERO, ZERO


@njit(**BORROWING)
def less(near, far, entry, cut_near, cut_far, cut_leave):
    """Entry into the first interval without the second one, and its face, 3 more on the cut."""
    outer = (near > NEAR) & (near <= far) & ((near < cut_near) | (near > cut_far))
    inner = (cut_far > NEAR) & (cut_far > near) & (cut_far < far) & (cut_near <= cut_far)
    t = near if outer else (cut_far if inner else NONE)
    return t, (entry if outer else cut_leave + np.float32(3))


@njit(**BORROWING)
def local(shapes, i, p, x, y, z):
    """A direction in the frame of the primitive whose fields begin at p, of shape i."""
    m = p + r.MATRIX
    return (
        shapes[i, m] * x + shapes[i, m + 1] * y + shapes[i, m + 2] * z,
        shapes[i, m + 3] * x + shapes[i, m + 4] * y + shapes[i, m + 5] * z,
        shapes[i, m + 6] * x + shapes[i, m + 7] * y + shapes[i, m + 8] * z,
    )


@njit(**BORROWING)
def local_point(shapes, i, p, x, y, z):
    """A point in the frame of the primitive whose fields begin at p, of shape i."""
    c = p + r.CENTER
    return local(shapes, i, p, x - shapes[i, c], y - shapes[i, c + 1], z - shapes[i, c + 2])


@njit(**BORROWING)
def hollow(shapes, i):
    """Whether shape i is bent or cut: it may shade itself, and fills little of its box."""
    return shapes[i, r.KIND] >= r.TORUS or shapes[i, r.PRIMITIVE_FIELDS] >= ZERO


@njit(**OPTIONS)
def height_of(heights, x, y):
    """As `height_at`, to be called from Python."""
    return height_at(heights, x, y)


@njit(**OPTIONS)
def clearances(shapes, points):
    """Metres (F, S) from points (F, 3) to the boxes around shapes, 0 inside."""
    distances = np.empty((points.shape[0], shapes.shape[0]))
    for f in range(points.shape[0]):
        for i in range(shapes.shape[0]):
            place = local_point(shapes, i, 0, points[f, 0], points[f, 1], points[f, 2])
            square = 0.0
            for a in range(3):
                away = max(abs(place[a]) - shapes[i, r.EXTENT + a], 0.0) * shapes[i, r.HALF + a]
                square += away * away
            distances[f, i] = math.sqrt(square)
    return distances

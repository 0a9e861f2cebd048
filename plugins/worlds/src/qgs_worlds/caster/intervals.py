"""Intersections of a ray o + t d with primitives, in the frame of the primitive.

An interval is the part of a ray inside a primitive: (entry t, exit t, entry face, exit face). A ray
that misses has entry inf and exit -inf. All numbers and constants are float32, because one float64
would slow the vectorised loops.
"""

import math

import numpy as np

from qgs.kernels import kernel
from qgs_worlds.caster import tables as s
from qgs_worlds.caster.vectors import along, dot, inner, minus

# Least distance of a hit in metres; cameras are never that near to a surface.
NEAR = np.float32(0.01)
NONE = np.float32(np.inf)
TINY = np.float32(1e-9)
ZERO = np.float32(0)
ONE = np.float32(1)
_HALF = np.float32(0.5)
_TWO = np.float32(2)
_FOUR = np.float32(4)
# of the search for a torus
_STEPS = 48
_TOUCH = np.float32(2e-4)
# of a height map's side, so that a point on the last line is in the last cell
_INSIDE = np.float32(0.99999)
# a step of the search in a height map goes at least this far, or rounding would stop it
_ADVANCE = np.float32(1e-6)
_NUDGE = np.float32(1e-3)


@inner
def reciprocal(x):
    """Return 1 / x, or a large number where x is 0."""
    # infinity times the 0 of an origin on a face would be NaN
    return ONE / (x if abs(x) > TINY else TINY)


@inner
def slab(o, inverse, h):
    """Return the t at which a ray enters and leaves the range -h to h on one axis.

    o, inverse: on this axis, the start of the ray and 1 / d.
    """
    a = (-h - o) * inverse
    b = (h - o) * inverse
    return min(a, b), max(a, b)


@inner
def nearest(o, d):
    """Return the point of a ray that is nearest to the origin, and its t along the ray."""
    t = -dot(o, d) / dot(d, d)
    return along(o, t, d), t


@inner
def ellipsoid(o, d):
    """Return the interval of a ray in the unit sphere; o is the ray's point nearest to 0."""
    inside = ONE - dot(o, o)
    root = math.sqrt(max(inside, ZERO) / dot(d, d))
    met = inside > ZERO
    return (-root if met else NONE), (root if met else -NONE), ZERO, ZERO


@inner
def ball(o, d, radius):
    """Return the interval of a ray in a sphere around the origin; the exit t (not used) is inf."""
    inverse = ONE / dot(d, d)
    middle = -dot(o, d) * inverse
    p = along(o, middle, d)
    inside = radius * radius - dot(p, p)
    root = math.sqrt(max(inside, ZERO) * inverse)
    met = inside > ZERO
    # shapes of furnished rooms have no cut, so nothing asks for the exit
    return (middle - root if met else NONE), NONE, ZERO, ZERO


@inner
def block(o, d, h):
    """Return the interval of a ray in a box of half sizes h; a face is its axis number, 0 to 2.

    The entry face is on the axis whose range of t begins last, the exit face on the axis whose
    range ends first.
    """
    x = slab(o[0], reciprocal(d[0]), h[0])
    y = slab(o[1], reciprocal(d[1]), h[1])
    z = slab(o[2], reciprocal(d[2]), h[2])
    near = max(x[0], y[0], z[0])
    far = min(x[1], y[1], z[1])
    entry = ZERO if near == x[0] else (ONE if near == y[0] else _TWO)
    leave = ZERO if far == x[1] else (ONE if far == y[1] else _TWO)
    return near, far, entry, leave


@inner
def box(o, d):
    """Return the interval of a ray in the cube [-1, 1]^3; a face is its axis number, 0 to 2."""
    return block(o, d, (ONE, ONE, ONE))


@inner
def interior(o, d, h):
    """Return an interval that starts where a ray hits a room from inside, and ends at infinity.

    The ray starts inside the room. Entry faces 0 to 3 are the walls at -x, +x, -y and +y, 4 is the
    floor (z = 0), 5 the ceiling. h: half size of the room in x and y, full size in z.
    """
    tx = (math.copysign(h[0], d[0]) - o[0]) / d[0]
    ty = (math.copysign(h[1], d[1]) - o[1]) / d[1]
    tz = ((h[2] if d[2] > ZERO else ZERO) - o[2]) / d[2]
    first_x = (tx <= ty) & (tx <= tz)
    first_y = ty <= tz
    t = tx if first_x else (ty if first_y else tz)
    toward = d[0] if first_x else (d[1] if first_y else d[2])
    face = ZERO if first_x else (_TWO if first_y else _FOUR)
    return t, NONE, face + (ONE if toward > ZERO else ZERO), ZERO


@inner
def _shaft(o, d, radius, half):
    """Return the t at which a ray meets an upright cylinder around the z axis, and its cap planes.

    Returns four t: entry and exit of the cylinder, first and second crossing of the cap planes.
    """
    low, high = slab(o[2], reciprocal(d[2]), half)
    inverse = reciprocal(d[0] * d[0] + d[1] * d[1])
    middle = -(o[0] * d[0] + o[1] * d[1]) * inverse
    x = o[0] + middle * d[0]
    y = o[1] + middle * d[1]
    inside = radius * radius - (x * x + y * y)
    root = math.sqrt(max(inside, ZERO) * inverse)
    near = max(low, middle - root)
    far = min(high, middle + root)
    met = (inside > ZERO) & (near <= far)
    return (near if met else NONE), (far if met else -NONE), low, high


@inner
def cylinder(o, d, h):
    """Return a ray's interval in a cylinder (radius h[0], half height h[2]); face 1 is a cap."""
    near, far, low, high = _shaft(o, d, h[0], h[2])
    return near, far, (ONE if near == low else ZERO), (ONE if far == high else ZERO)


@inner
def capsule(o, d, half):
    """Return the interval of a ray in a capsule.

    The capsule has radius 1 around the z axis from z = -half to half.
    """
    near, far, _, _ = _shaft(o, d, ONE, half)
    # the ends are whole spheres, because their inner halves are inside the shaft
    for end in (-half, half):
        p, shift = nearest((o[0], o[1], o[2] - end), d)
        first, last, _, _ = ellipsoid(p, d)
        near = min(near, first + shift)
        far = max(far, last + shift)
    return near, far, ZERO, ZERO


@inner
def frustum(o, d, top):
    """Return the interval of a ray in a truncated cone from z = -1 to 1.

    The radius is 1 at z = -1 and `top` <= 1 at z = 1. Face 1 is a cap, face 0 the side.
    """
    # caps come first, because they cut off the side
    low, high = slab(o[2], reciprocal(d[2]), ONE)
    slope = _HALF * (top - ONE)
    radius = _HALF * (top + ONE) + slope * o[2]
    change = slope * d[2]
    a = d[0] * d[0] + d[1] * d[1] - change * change
    b = o[0] * d[0] + o[1] * d[1] - change * radius
    c = o[0] * o[0] + o[1] * o[1] - radius * radius
    # 0 for a ray along the side, which meets the cone only once
    a = a if abs(a) > TINY else TINY
    square = b * b - a * c
    root = math.sqrt(max(square, ZERO))
    # roots without a difference of similar numbers
    q = -(b + math.copysign(root, b))
    one = q / a
    other = c / (q if abs(q) > TINY else TINY)
    first = min(one, other)
    second = max(one, other)
    # a steep ray is inside both halves of the double cone: on the side below the tip
    down = d[2] < ZERO
    side_near = first if a > ZERO else (second if down else -NONE)
    side_far = second if a > ZERO else (NONE if down else first)
    near = max(low, side_near)
    far = min(high, side_far)
    met = square > ZERO
    entry = ONE if near == low else ZERO
    leave = ONE if far == high else ZERO
    return (near if met else NONE), (far if met else -NONE), entry, leave


@inner
def torus(o, d, thickness, start):
    """Return an interval whose entry and exit are both the first hit of a torus at t >= `start`.

    The torus lies in the xy plane and has outer radius 1. The search uses sphere tracing, because
    the roots of the quartic equation miss thin rings in float32.
    """
    step = ONE / math.sqrt(dot(d, d))
    t, end, _, _ = ellipsoid(o, d)
    low, high = slab(o[2], reciprocal(d[2]), thickness)
    t = max(t, low, start)
    end = min(end, high)
    ring = ONE - thickness
    for _ in range(_STEPS):
        if t > end:
            break
        x, y, z = along(o, t, d)
        across = math.sqrt(x * x + y * y) - ring
        away = math.sqrt(across * across + z * z) - thickness
        if away < _TOUCH:
            return t, t, ZERO, ZERO
        t += away * step
    return NONE, -NONE, ZERO, ZERO


@kernel
def height_at(heights, x, y):
    """Return the height at x, y in [-1, 1], interpolated in the height map `heights` (G, G).

    Points outside of the map have the height at its border.
    """
    last = np.float32(heights.shape[0] - 1)
    a = min(max((x + ONE) * _HALF, ZERO), _INSIDE) * last
    b = min(max((y + ONE) * _HALF, ZERO), _INSIDE) * last
    i = int(a)
    j = int(b)
    a = a - np.float32(i)
    b = b - np.float32(j)
    low = heights[i, j] + b * (heights[i, j + 1] - heights[i, j])
    high = heights[i + 1, j] + b * (heights[i + 1, j + 1] - heights[i + 1, j])
    return low + a * (high - low)


@inner
def _above(heights, o, d, t):
    x, y, z = along(o, t, d)
    return z - height_at(heights, x, y)


@inner
def _next_line(o, d, t, cells):
    """Return the t at which a ray crosses the next border of a height map's cells, on one axis.

    o, d: start and direction of the ray on this axis. t: value after which the search begins.
    cells: number of the map's cells on this axis.
    """
    if abs(d) < TINY:
        return NONE
    place = (o + t * d + ONE) * _HALF * cells
    line = math.floor(place + _NUDGE) + 1 if d > ZERO else math.ceil(place - _NUDGE) - 1
    return (np.float32(line) / cells * _TWO - ONE - o) / d


@inner
def _surface_between(heights, o, d, t, above, line, below):
    """Return the t between `t` and `line` at which a ray hits a height map.

    above: height of the ray over the map at `t`, positive. below: this height at `line`, negative.
    """
    # regula falsi, because heights along a ray in one cell are a parabola
    for _ in range(3):
        middle = t + (line - t) * above / (above - below)
        height = _above(heights, o, d, middle)
        if height < ZERO:
            line = middle
            below = height
        else:
            t = middle
            above = height
    return t + (line - t) * above / (above - below)


@inner
def relief(o, d, heights, start):
    """Return an interval whose entry and exit are the first hit of a height map at t >= `start`.

    The map bounds a solid: the part of the cube [-1, 1]^3 below the map. Face 0 is the top of the
    solid, face 1 a side.
    """
    t, end, _, _ = box(o, d)
    t = max(t, start)
    if t > end:
        return NONE, -NONE, ZERO, ZERO
    cells = np.float32(heights.shape[0] - 1)
    above = _above(heights, o, d, t)
    # a ray that enters the cube below the map meets a wall of the solid, not its top
    if above < ZERO:
        return t, t, ONE, ONE
    while t < end:
        line = min(_next_line(o[0], d[0], t, cells), _next_line(o[1], d[1], t, cells))
        line = min(max(line, t + _ADVANCE), end)
        below = _above(heights, o, d, line)
        if below < ZERO:
            t = _surface_between(heights, o, d, t, above, line, below)
            return t, t, ZERO, ZERO
        t = line
        above = below
    return NONE, -NONE, ZERO, ZERO


@inner
def less(near, far, entry, cut_near, cut_far, cut_leave):
    """Return the t at which a ray enters a body from which a cut is removed, and the face there.

    near, far, entry: entry t, exit t and entry face of the body. cut_near, cut_far, cut_leave:
    entry t, exit t and exit face of the cut. Each face of the cut's wall has the number of
    the cut's face plus 3. A ray that misses has t = inf.
    """
    outer = (near > NEAR) & (near <= far) & ((near < cut_near) | (near > cut_far))
    # a ray that starts in the cut, or enters through it, hits the wall of the cut
    inner = (cut_far > NEAR) & (cut_far > near) & (cut_far < far) & (cut_near <= cut_far)
    t = near if outer else (cut_far if inner else NONE)
    return t, (entry if outer else cut_leave + np.float32(3))


@inner
def local(primitive, v):
    """Return the direction v, given in the world frame, in the frame of a primitive."""
    axes = primitive.axes
    return dot(axes[0], v), dot(axes[1], v), dot(axes[2], v)


@inner
def local_point(primitive, p):
    """Return the point p, given in the world frame, in the frame of a primitive."""
    return local(primitive, minus(p, primitive.center))


@inner
def hollow(shape):
    """Return True for a torus, a height map or a cut shape, which may cast shadows on itself."""
    return shape.body.kind >= s.TORUS or shape.cut.kind != s.NOTHING


@kernel
def hit(body, o, d):
    """Return the t at which a ray enters a BLOCK, BALL or CYLINDER; inf if the ray misses."""
    p = local_point(body, o)
    way = local(body, d)
    if body.kind == s.BLOCK:
        near, far, _, _ = block(p, way, body.extent)
    elif body.kind == s.BALL:
        near, far, _, _ = ball(p, way, body.extent[0])
    else:
        near, far, _, _ = cylinder(p, way, body.extent)
    return near if (near > NEAR) & (near <= far) else NONE


def clearances(shapes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distances in metres from F points (F, 3) to the boxes around S shapes, (F, S).

    A point inside a box has distance 0.
    """
    body = shapes["body"]
    way = points[:, None] - body["center"]
    place = (body["axes"] @ way[..., None])[..., 0]
    away = np.maximum(abs(place) - body["extent"], 0) * body["unit"]
    return np.linalg.norm(away, axis=-1)

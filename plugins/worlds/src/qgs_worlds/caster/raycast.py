"""Find the first hit of each ray of an image. A shape is tested only in the pixels it may cover.

The ray of pixel (u, v) is o + t d, with camera centre o and d = B (1, u, v) for a 3 x 3 matrix B.
The z of d is 1 in the camera frame, so t is the depth.
"""

import numpy as np

from qgs.kernels import kernel
from qgs_worlds.caster import tables as s
from qgs_worlds.caster.intervals import (
    NEAR,
    NONE,
    ZERO,
    ball,
    block,
    box,
    capsule,
    cylinder,
    ellipsoid,
    frustum,
    interior,
    less,
    local,
    local_point,
    nearest,
    relief,
    torus,
)
from qgs_worlds.caster.vectors import along, dot, inner, minus, mix, narrow, over, triple

# Part p of shape i has code 8 i + p; codes are float32, so that loops vectorise them with t.
SKY = -1
# Shapes are clipped nearer than this to the camera plane, in metres.
_PLANE = 0.02


@inner
def _corners(body, c2w, corners):
    """Write the corners of the box around a primitive, in the camera frame, to `corners` (8, 3)."""
    middle = minus(body.center, c2w[:, 3])
    for a in range(3):
        toward = c2w[:, a]
        center = dot(toward, middle)
        # axes are a rotation divided by the units; times their squares they are half sizes
        x = dot(toward, body.axes[0]) * body.unit[0] * body.unit[0] * body.extent[0]
        y = dot(toward, body.axes[1]) * body.unit[1] * body.unit[1] * body.extent[1]
        z = dot(toward, body.axes[2]) * body.unit[2] * body.unit[2] * body.extent[2]
        for k in range(8):
            across = (x if k & 1 else -x) + (y if k & 2 else -y)
            corners[k, a] = center + across + (z if k & 4 else -z)


@inner
def _covered(corners, intrinsics):
    """Return the range u0, u1, v0, v1 of pixel coordinates that a box covers.

    Only the part of the box in front of the camera counts; if the whole box is behind the camera,
    u0 > u1. corners: result of `_corners`.
    """
    u0 = v0 = np.inf
    u1 = v1 = -np.inf
    for k in range(8):
        for axis in range(3):
            start = corners[k]
            end = corners[k ^ (1 << axis)]
            # a corner bounds the box in the image, or else where its edge comes to the front
            if start[2] > _PLANE:
                w = 0.0
            elif end[2] > _PLANE:
                w = (_PLANE - start[2]) / (end[2] - start[2])
            else:
                continue
            x, y, z = mix(start, end, w)
            u = intrinsics[0] * x / z + intrinsics[2]
            v = intrinsics[1] * y / z + intrinsics[3]
            u0 = min(u0, u)
            u1 = max(u1, u)
            v0 = min(v0, v)
            v1 = max(v1, v)
    return u0, u1, v0, v1


@inner
def _span(low, high, samples, first, count):
    """Return the first index and the end index of the samples between two pixel coordinates.

    All values are on one axis. low, high: the two coordinates. samples: samples per pixel. first:
    pixel of sample 0. count: number of all samples.
    """
    # half a sample more on both sides, because bounds and rays round differently
    low = (low - first) * samples - 0.5
    high = (high - first) * samples + 0.5
    return int(min(max(low, 0.0), count)), int(min(max(high + 1, 0.0), count))


@inner
def ray_basis(c2w, intrinsics):
    """Return the three columns of the ray basis, a matrix B, in the world frame.

    The ray of pixel (u, v) has direction d = B (1, u, v).
    """
    right = over(c2w[:, 0], intrinsics[0])
    down = over(c2w[:, 1], intrinsics[1])
    corner = along(along(c2w[:, 2], -intrinsics[2], right), -intrinsics[3], down)
    return corner, right, down


@inner
def _row_base(rays, v):
    """Return the direction of the ray of pixel (0, v) for a ray basis `rays`."""
    return narrow(along(rays[0], v, rays[2]))


@inner
def _ray(o, base, step, u):
    """Return the point of a ray nearest to the origin, the ray's direction, and the point's t.

    o, base, step: start of the ray, direction of the ray at pixel 0 of its row, and change of
    direction per pixel. u: pixel coordinate in the row. Intersections are computed with the nearest
    point as the start of the ray: from a distant start, float32 would lose thin shapes.
    """
    d = along(base, u, step)
    p, t = nearest(o, d)
    return p, d, t


@inner
def _store(spans, k, found, t):
    near, far, entry, leave = found
    spans[0, k] = near + t
    spans[1, k] = far + t
    spans[2, k] = entry
    spans[3, k] = leave


@inner
def _inside_row(kind, extra, heights, steps, o, base, step, spans):
    """Intersect the R rays of a row with a primitive, and write their intervals to `spans` (4, R).

    An interval is entry t, exit t, entry face and exit face. kind, extra: fields of the primitive.
    steps: pixel coordinates (R,) of the rays in the row. o, base, step: start of the rays,
    direction of the ray at pixel 0, and change of direction per pixel. Each kind of primitive has
    its own loop, because LLVM vectorises loops without branches.
    """
    count = steps.shape[0]
    if kind == s.ELLIPSOID:
        for k in range(count):
            p, d, t = _ray(o, base, step, steps[k])
            _store(spans, k, ellipsoid(p, d), t)
    elif kind == s.BOX:
        for k in range(count):
            p, d, t = _ray(o, base, step, steps[k])
            _store(spans, k, box(p, d), t)
    elif kind == s.FRUSTUM:
        for k in range(count):
            p, d, t = _ray(o, base, step, steps[k])
            _store(spans, k, frustum(p, d, extra), t)
    elif kind == s.CAPSULE:
        for k in range(count):
            p, d, t = _ray(o, base, step, steps[k])
            _store(spans, k, capsule(p, d, extra), t)
    else:
        for k in range(count):
            p, d, t = _ray(o, base, step, steps[k])
            if kind == s.TORUS:
                # p is at t, so the camera is at -t: what lies behind it is no hit
                _store(spans, k, torus(p, d, extra, -t), t)
            else:
                _store(spans, k, relief(p, d, heights, -t), t)


@inner
def _closest(t, code, own, first, second):
    """Update the hits of a row of R rays where a shape is nearer than all earlier shapes.

    t, code: depths and face codes (R,) of the hits. own: code of the shape. first, second:
    intervals (4, R) of the shape's body and of its cut.
    """
    for k in range(t.shape[0]):
        near, face = less(
            first[0, k], first[1, k], first[2, k], second[0, k], second[1, k], second[3, k]
        )
        closer = near < t[k]
        t[k] = near if closer else t[k]
        code[k] = own + face if closer else code[k]


@inner
def _keep(t, code, k, own, found):
    near, far, face, _ = found
    closer = (near > NEAR) & (near <= far) & (near < t[k])
    t[k] = near if closer else t[k]
    code[k] = own + face if closer else code[k]


@inner
def _cover_row(t, code, own, kind, extent, steps, o, base, step):
    """Update the hits of a row of rays where a room's shape is nearer than all earlier shapes.

    A room's shape has no cut, so no intervals are stored, which saves two thirds of the time.
    extent: half sizes of the shape. The other arguments are those of `_closest` and `_inside_row`.
    """
    if kind == s.BLOCK:
        for k in range(t.shape[0]):
            _keep(t, code, k, own, block(o, along(base, steps[k], step), extent))
    elif kind == s.BALL:
        for k in range(t.shape[0]):
            _keep(t, code, k, own, ball(o, along(base, steps[k], step), extent[0]))
    elif kind == s.CYLINDER:
        for k in range(t.shape[0]):
            _keep(t, code, k, own, cylinder(o, along(base, steps[k], step), extent))
    else:
        for k in range(t.shape[0]):
            _keep(t, code, k, own, interior(o, along(base, steps[k], step), extent))


@inner
def _trace_primitive(primitive, heights, o, base, step, steps, spans):
    field = heights[int(primitive.extra) if primitive.kind == s.HEIGHT else 0]
    lo = local_point(primitive, o)
    ls = local(primitive, step)
    lb = local(primitive, base)
    _inside_row(primitive.kind, primitive.extra, field, steps, lo, lb, ls, spans)


@inner
def _trace_shape(t, code, top, samples, shape, own, heights, o, rays, steps, area, scratch):
    """Update the hit of each ray for which this shape is nearer than all earlier shapes.

    t, code: depths and face codes of the hits. top: first pixel row of the band. samples: rays per
    pixel along each axis. own: code of the shape. o: start of the rays. rays: the ray basis. steps:
    pixel coordinates of the rays in a row. area: first row, end row, first column and end column of
    the rays. scratch: working memory.
    """
    above, below, first, last = area
    body = shape.body
    step = narrow(rays[1])
    along_row = steps[first:last]
    # a room's shape is upright and has no cut
    if body.kind >= s.BLOCK:
        extent = triple(body.extent)
        lo = local_point(body, o)
        ls = local(body, step)
        for row in range(above, below):
            lb = local(body, _row_base(rays, top + (row + 0.5) / samples))
            depths = t[row, first:last]
            codes = code[row, first:last]
            _cover_row(depths, codes, own, body.kind, extent, along_row, lo, lb, ls)
        return
    spans = scratch[:, :, : last - first]
    # without a second primitive there is no cut
    spans[1, 0] = NONE
    spans[1, 1] = -NONE
    spans[1, 3] = ZERO
    for row in range(above, below):
        base = _row_base(rays, top + (row + 0.5) / samples)
        _trace_primitive(body, heights, o, base, step, along_row, spans[0])
        if shape.cut.kind != s.NOTHING:
            _trace_primitive(shape.cut, heights, o, base, step, along_row, spans[1])
        _closest(t[row, first:last], code[row, first:last], own, spans[0], spans[1])


@kernel
def trace(rows, columns, top, samples, shapes, heights, c2w, intrinsics):
    """Return depth t, face code and ray basis of a band of image rows.

    t and code are (R, C) float32. The band has `rows` pixel rows from row `top` on, with samples x
    samples rays per pixel, so R = rows * samples and C = columns * samples. A ray without a hit has
    t = inf and code SKY. The ray basis is the result of `ray_basis`.
    """
    t = np.full((rows * samples, columns * samples), NONE, np.float32)
    code = np.full((rows * samples, columns * samples), np.float32(SKY), np.float32)
    rays = ray_basis(c2w, intrinsics)
    steps = np.empty(columns * samples, np.float32)
    for j in range(columns * samples):
        steps[j] = (j + 0.5) / samples
    o = narrow(c2w[:, 3])
    corners = np.empty((8, 3))
    # one for all shapes, because allocating takes longer than small shapes do
    scratch = np.empty((2, 4, columns * samples), np.float32)
    # shape by shape, not ray by ray, because a loop over a row is vectorised
    for i in range(shapes.shape[0]):
        shape = shapes[i]
        _corners(shape.body, c2w, corners)
        u0, u1, v0, v1 = _covered(corners, intrinsics)
        first, last = _span(u0, u1, samples, 0.0, columns * samples)
        above, below = _span(v0, v1, samples, top, rows * samples)
        if first >= last or above >= below:
            continue
        area = (above, below, first, last)
        own = np.float32(8 * i)
        _trace_shape(t, code, top, samples, shape, own, heights, o, rays, steps, area, scratch)
    return t, code, rays

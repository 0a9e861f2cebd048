"""Shadows of lights by shadow maps, and ambient occlusion.

The ray caster renders the shadow maps once per scene. Ambient occlusion darkens points near other
shapes; it is estimated from boxes around shapes.
"""

import math

import numpy as np

from qgs.kernels import kernel
from qgs_worlds.caster import tables as s
from qgs_worlds.caster.intervals import ZERO, hollow, local
from qgs_worlds.caster.raycast import trace
from qgs_worlds.caster.vectors import dot, inner, longest, minus, narrow, reducing

# Fields of a box: matrix, centre in its frame, extents, units and the number of its shape.
_FIELDS = 19
# Side in pixels of the sun's map, and of each of the six maps of a lamp.
_SUN_SIDE = 224
_LAMP_SIDE = 72
# Distance of the sun in metres: far enough for nearly parallel rays, near enough for float32.
_SUN = 300.0

_AXES = ((1, 2, 0), (0, 2, 1), (0, 1, 2))
# Rotations of a lamp's cameras, which look along +x, -x, +y, -y, +z, -z.
_FACES = [np.eye(3)[:, axes] * (1, 1, sign) for axes in _AXES for sign in (1, -1)]


def shadow_maps(
    shapes: np.ndarray, heights: np.ndarray, lights: np.ndarray, middle: np.ndarray, radius: float
) -> tuple[np.ndarray, s.Shadows]:
    """Return a copy of `lights` and the shadow maps of all lights.

    In the copy, the field `shadows` of a light with shadows is the index of its first map plus 1.
    middle, radius: ball in which the sun casts shadows. Lamps cast shadows everywhere.
    """
    lights = lights.copy()
    maps = []
    # at least one array of each, because a scene may have no shadows
    depths = [np.zeros(0, np.float32)]
    codes = [np.zeros(0, np.float32)]
    begin = 0
    for light in lights:
        if not light["shadows"]:
            continue
        light["shadows"] = len(maps) + 1
        for c2w, side, focal in _views(light, middle, radius):
            lens = np.array([focal, focal, side / 2, side / 2])
            t, code, _ = trace(side, side, 0, 1, shapes, heights, c2w, lens)
            maps.append((begin, side, focal, c2w))
            depths.append(t.ravel())
            codes.append(code.ravel())
            begin += side * side
    return lights, s.Shadows(np.array(maps, s.MAP), np.concatenate(depths), np.concatenate(codes))


def _views(
    light: np.ndarray, middle: np.ndarray, radius: float
) -> list[tuple[np.ndarray, int, float]]:
    """Return a tuple for each shadow map of a light: pose (3, 4), side and focal length, pixels."""
    place = light["place"]
    if light["lamp"]:
        # a focal length of half the side is a right angle of view: six of them see everything
        return [(np.column_stack([face, place]), _LAMP_SIDE, _LAMP_SIDE / 2) for face in _FACES]
    right = np.array([-place[1], place[0], 0.0]) / math.hypot(*place[:2])
    pose = np.stack([right, np.cross(-place, right), -place, middle + _SUN * place], -1)
    return [(pose, _SUN_SIDE, _SUN_SIDE / 2 * _SUN / radius)]


@inner
def _seen(shadows, k, own, p):
    """Return the share of light that reaches point p, by shadow map number k; 1 outside the map.

    own: index of the shape on which p lies, if this shape cannot cast a shadow on itself; otherwise
    -1.
    """
    view = shadows.maps[k]
    side = view.side
    place = minus(p, view.c2w[:, 3])
    depth = dot(place, view.c2w[:, 2])
    scale = view.focal / depth
    a = scale * dot(place, view.c2w[:, 0]) + 0.5 * side - 0.5
    b = scale * dot(place, view.c2w[:, 1]) + 0.5 * side - 0.5
    # written so that NaN counts as outside
    if not (a > -1 and a < side and b > -1 and b < side):
        return 1.0
    # below the last pixel, so that a second one exists in both directions
    a = min(max(a, 0.0), side - 1.001)
    b = min(max(b, 0.0), side - 1.001)
    i = int(b)
    j = int(a)
    a = a - j
    b = b - i
    # within a pixel of the map, the depth of a shape that shades itself varies
    bias = np.float32(depth - 0.01 - (1.5 / scale if own < 0 else 0.0))
    # percentage closer filtering over 2 x 2 pixels softens the edge
    light = 0.0
    for row in range(2):
        for column in range(2):
            at = view.begin + (i + row) * side + j + column
            if shadows.depths[at] > bias or (int(shadows.codes[at]) >> 3) == own:
                light += (b if row else 1 - b) * (a if column else 1 - a)
    return light


@inner
def lit(shadows, light, own, p):
    """Return the share of a light that reaches point p, from 0 (in shadow) to 1.

    own: index of the shape on which p lies, if this shape cannot cast a shadow on itself; otherwise
    -1.
    """
    k = light.shadows - 1
    if light.lamp > 0:
        away = minus(p, light.place)
        axis = longest(away)
        k += 2 * axis + (0 if away[axis] > 0 else 1)
    return _seen(shadows, k, own, p)


@kernel
def surroundings(shapes):
    """Return the cache that `visible` keeps between points: two arrays.

    The first array (19, S) has space for 19 fields of the boxes around S shapes, field by field, so
    that loops over shapes are vectorised; it gets the boxes near a point p. The second array (5,)
    has p, the number of boxes near p, and the squared distance from p up to which these boxes are
    valid.
    """
    return np.empty((_FIELDS, shapes.shape[0]), np.float32), np.full(5, np.inf)


@inner
def _find(shapes, around, p, reach, slack):
    """Write the boxes near point p to the cache `around`, except boxes of `hollow` shapes.

    reach: distance in metres at which shapes darken points. slack: distance in metres from p up to
    which the written boxes stay valid.
    """
    near, place = around
    place[:3] = p
    place[4] = slack * slack
    count = 0
    reach = np.float32(1.6 * reach + slack)
    for i in range(shapes.shape[0]):
        body = shapes[i].body
        away = minus(body.center, p)
        size = shapes[i].radius + reach
        if dot(away, away) < size * size and not hollow(shapes[i]):
            center = local(body, body.center)
            for k in range(3):
                for axis in range(3):
                    near[3 * k + axis, count] = body.axes[k, axis]
                near[9 + k, count] = center[k]
                near[12 + k, count] = body.extent[k]
                near[15 + k, count] = body.unit[k]
            near[18, count] = i
            count += 1
    place[3] = count


@reducing
def visible(shapes, around, own, point, normal, strength, reach, footprint):
    """Return the share of ambient light that reaches a point; 1 without occlusion.

    At two heights above the point, light is lost if another shape is nearer than the height, after
    Evans 2006, "Fast approximations for global illumination on dynamic scenes". around: cache
    from `surroundings`. own: index of the shape on which the point lies. strength: amount of
    darkening; 0 for none. reach: distance at which shapes darken points. footprint: distance
    between neighbouring pixels at the point. Lengths are in metres.
    """
    x, y, z = narrow(point)
    nx, ny, nz = narrow(normal)
    low = np.float32(0.25 * reach)
    high = np.float32(0.8 * reach)
    near, place = around
    moved = minus(place, point)
    if place[4] == np.inf or dot(moved, moved) > place[4]:
        _find(shapes, around, (x, y, z), reach, 0.3 * reach + 4 * footprint)
    # float32 like the boxes, so that the loop stays narrow
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
    # light is lost by as much as the nearest shape is nearer than the height itself
    hidden = max(1 - math.sqrt(first) / low, ZERO) + max(1 - math.sqrt(second) / high, ZERO)
    return 1.0 - 0.5 * strength * hidden

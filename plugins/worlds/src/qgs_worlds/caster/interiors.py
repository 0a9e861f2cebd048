"""Colours of surfaces in furnished rooms, lit by ambient light, a lamp and a window."""

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from qgs.kernels import kernel
from qgs_worlds.caster import tables as s
from qgs_worlds.caster.intervals import height_at, hit, local_point
from qgs_worlds.caster.patterns import mixture, smooth
from qgs_worlds.caster.shading import TAKEN, on_axis, to_world
from qgs_worlds.caster.vectors import along, dot, inner, minus, mix, narrow, times, triple

# Share of the light that the lamp's shadow removes.
_SHADOW = 0.36
_SHADOW_CELLS = 80
# Start and direction of rays that search for shapes above a point of the floor.
_UNDER = np.float32(-1)
_UP = (np.float32(0), np.float32(0), np.float32(10))
_FLOOR = 4
# Flat things on the floor below this height show the floor's shadows.
_FLAT = 0.03


@inner
def _range(low, high, lamp, reach, extent, cells):
    """Return first and end index of the floor cells that a shape and its shadow cover on one axis.

    All arguments are values on this axis. low, high: limits of the shape. lamp: position of the
    lamp. reach: distance from the lamp to the shadow's edge, divided by the distance from the lamp
    to the shape's edge. extent: size of the room. cells: number of floor cells.
    """
    start = min(low, lamp + (low - lamp) * reach)
    end = max(high, lamp + (high - lamp) * reach)
    first = math.floor((start / extent + 0.5) * (cells - 1))
    last = math.ceil((end / extent + 0.5) * (cells - 1)) + 1
    return max(first, 0), min(last, cells)


@inner
def _darken(darkness, body, size, lamp):
    """Darken the floor below a shape and in the shadow that the lamp casts behind the shape.

    darkness: share of light lost in each cell of the floor, (C, C). size: extent of the
    room in metres. lamp: position of the lamp.
    """
    cells = darkness.shape[0]
    x, y, z = triple(body.center)
    bottom = z - body.extent[2]
    top = z + body.extent[2]
    # high or flat things cast no visible shadow
    if bottom > 1.2 or top < 0.03 or top > lamp[2] - 0.2:
        return
    # half of the diagonal, which bounds a shape turned by any angle
    wide = math.hypot(body.extent[0], body.extent[1])
    # how far the shadow of the shape's top edge reaches on the floor
    reach = lamp[2] / (lamp[2] - top)
    i0, i1 = _range(x - wide, x + wide, lamp[0], reach, size[0], cells)
    j0, j1 = _range(y - wide, y + wide, lamp[1], reach, size[1], cells)
    source = narrow(lamp)
    below = 0.55 * math.exp(-3 * bottom)
    for i in range(i0, i1):
        x = (i / (cells - 1) - 0.5) * size[0]
        for j in range(j0, j1):
            y = (j / (cells - 1) - 0.5) * size[1]
            dark = 0.0
            if hit(body, (np.float32(x), np.float32(y), _UNDER), _UP) < 1:
                dark = below
            ray = (np.float32(x - lamp[0]), np.float32(y - lamp[1]), np.float32(-lamp[2]))
            # t is 1 on the floor, so an earlier hit is between floor and lamp
            if hit(body, source, ray) < 1:
                dark = max(dark, _SHADOW)
            darkness[i, j] = max(darkness[i, j], dark)


@kernel
def darkened_floor(shapes, size, lamp):
    """Return the shares (C, C) of the light on the floor that shadows remove.

    The shares are indexed by cell along x, then along y.
    """
    darkness = np.zeros((_SHADOW_CELLS, _SHADOW_CELLS))
    # the first shape is the room
    for i in range(1, shapes.shape[0]):
        _darken(darkness, shapes[i].body, size, lamp)
    return darkness


def blurred(values: np.ndarray) -> np.ndarray:
    """Return a blurred map (C, C): each cell is the mean of the 3 x 3 cells around it."""
    padded = np.pad(values, 1, "edge")
    return sliding_window_view(padded, (3, 3)).mean((2, 3))


@inner
def _on_round(body, part, p):
    """Return the normal and four texture coordinates of a point on a ball or a cylinder.

    p: point in the shape's frame. part: 1 for a cap of the cylinder, 0 for any other point. The
    first two coordinates are in metres; the last two run from -1 to 1 across the surface.
    """
    x, y, z = p
    radius = float(body.extent[0])
    if part == 1:
        return (0.0, 0.0, math.copysign(1.0, z)), x, y, x / radius, y / radius
    angle = math.atan2(y, x)
    normal = (x / radius, y / radius, z / radius if body.kind == s.BALL else 0.0)
    return normal, angle * radius, z, angle / math.pi, z / body.extent[2]


@inner
def _surface(shape, part, place):
    """Return texture index, world normal and four texture coordinates of a point on a shape.

    part: number of the face that the ray hit. place: the point in the world frame. The first two
    coordinates are in metres; the last two run from -1 to 1 across the surface.
    """
    body = shape.body
    inside = body.kind == s.INTERIOR
    # the frame of the room is the world frame
    p = place if inside else local_point(body, place)
    if body.kind == s.BALL or body.kind == s.CYLINDER:
        normal, u, v, across, up = _on_round(body, part, p)
        return shape.texture, to_world(body, normal), u, v, across, up
    axis = part >> 1 if inside else part
    normal, u, v, _ = on_axis(axis, p, (1.0, 1.0, 1.0))
    across = u / body.extent[1 if axis == 0 else 0]
    up = v / body.extent[1 if axis == 2 else 2]
    if inside:
        # the sign of z is meaningless on the floor, which is at 0
        inward = 1.0 - 2.0 * (part & 1)
        normal = (inward * abs(normal[0]), inward * abs(normal[1]), inward * abs(normal[2]))
        return shape.texture + part, normal, u, v, across, up
    return shape.texture, to_world(body, normal), u, v, across, up


@inner
def _edge(distance):
    return 1 - 0.30 / (1 + 6 * distance) ** 2


@inner
def _wall_shadow(place, size, face):
    """Return a light factor for a point on a wall, the floor or the ceiling.

    The factor is smaller near the edges, where two of these surfaces meet. face: number of the
    surface, 0 to 5. size: extent of the room in metres.
    """
    x, y, z = place
    a = 1.0 if face < 2 else _edge(0.5 * size[0] - abs(x))
    b = 1.0 if face == 2 or face == 3 else _edge(0.5 * size[1] - abs(y))
    c = 1.0 if face >= 4 else _edge(z) * _edge(size[2] - z)
    return a * b * c


@inner
def _floor_shadow(floor, place, size):
    """Return the light factor of the floor at a point, interpolated between cells of `floor`."""
    return height_at(floor, 2 * place[0] / size[0], 2 * place[1] / size[1])


@inner
def _shadow(room, code, place, normal):
    if code < 8:
        shadow = _wall_shadow(place, room.size, code)
        return shadow * _floor_shadow(room.floor, place, room.size) if code == _FLOOR else shadow
    if place[2] < _FLAT and normal[2] > 0.5:
        return _floor_shadow(room.floor, place, room.size)
    return 1 - 0.4 / (1 + 3 * place[2]) ** 2


@inner
def _light(room, code, place, normal):
    """Return the RGB light at a point: ambient light, and diffuse light of lamp and window.

    code: face code of the surface. place, normal: the point and its normal in the world frame.
    """
    # more light on surfaces that face down; otherwise ceilings would be dark
    even = 0.56 - 0.12 * normal[2]
    total = (even, even, even)
    for k in range(room.lights.shape[0]):
        light = room.lights[k]
        toward = minus(light.place, place)
        square = dot(toward, toward)
        cosine = max(dot(normal, toward) / math.sqrt(square), 0.0)
        # falls off less than the square, because walls reflect light
        total = along(total, cosine / (1 + 0.12 * square), light.color)
    return times(_shadow(room, code, place, normal), total)


@inner
def _gather(t, code, i, j, own, samples, top, o, rays, points):
    """Write the points where a pixel's rays hit the face `own` to `points`; return their number n.

    Rows 1 to n of `points` are the hits, row 0 is their mean. In `code`, which has the face of each
    ray, these rays are marked as TAKEN.
    """
    n = 0
    step = 1.0 / samples
    total = (0.0, 0.0, 0.0)
    for a in range(samples):
        for b in range(samples):
            if code[i + a, j + b] == own:
                code[i + a, j + b] = TAKEN
                n += 1
                u = (j + b + 0.5) * step
                v = top + (i + a + 0.5) * step
                d = along(along(rays[0], u, rays[1]), v, rays[2])
                place = along(o, t[i + a, j + b], d)
                total = along(total, 1.0, place)
                points[n] = place
    points[0] = times(1 / n, total)
    return n


@inner
def _albedo(texture, shape, part, points, n, footprint):
    """Return the mean RGB of a texture over the hits of a pixel, rows 1 to n of `points`.

    A texture without sharp edges is evaluated only once, at the mean of the hits in row 0.
    """
    first = 0 if smooth(texture.pattern) else 1
    last = 1 if smooth(texture.pattern) else n + 1
    # edges need all samples of a pixel, gradients do not
    second = third = 0.0
    for k in range(first, last):
        _, _, u, v, across, up = _surface(shape, part, triple(points[k]))
        b, c = mixture(texture, u, v, across, up, footprint)
        second += b * (1 - c)
        third += c
    base = triple(texture.colors[0])
    rgb = mix(base, texture.colors[1], second / (last - first))
    return along(rgb, third / (last - first), minus(texture.colors[2], base))


@inner
def _shade(room, code, points, n, footprint):
    """Return the mean RGB of a face, in [0, 1], over the hits in rows 1 to n of `points`."""
    shape = room.shapes[code >> 3]
    place = triple(points[0])
    row, normal, _, _, _, _ = _surface(shape, code & 7, place)
    texture = room.textures[row]
    albedo = _albedo(texture, shape, code & 7, points, n, footprint)
    light = _light(room, code, place, normal)
    red, green, blue = mix(light, (1.0, 1.0, 1.0), texture.emission)
    return min(albedo[0] * red, 1.0), min(albedo[1] * green, 1.0), min(albedo[2] * blue, 1.0)


@kernel
def paint_room(image, t, code, top, samples, room, c2w, rays):
    """Write the colours of a band of image rows to `image` (rows, W, 3) uint8; overwrite `code`.

    t, code, rays: results of `trace` for the band: depth and face hit by each ray, and ray basis.
    top: number of the band's first row in the image. Rays of a pixel that hit the same face share
    one computation of light; if the texture has no sharp edges, they share its colour too.
    """
    eye = triple(c2w[:, 3])
    points = np.empty((samples * samples + 1, 3))
    step = 1.0 / samples
    gain = 255.0 * step * step
    spread = step * math.sqrt(dot(rays[1], rays[1]))
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            total = (0.0, 0.0, 0.0)
            i = row * samples
            j = column * samples
            for a in range(samples):
                for b in range(samples):
                    own = code[i + a, j + b]
                    if own == TAKEN:
                        continue
                    n = _gather(t, code, i, j, own, samples, top, eye, rays, points)
                    seen = _shade(room, int(own), points, n, spread * t[i + a, j + b])
                    total = along(total, n, seen)
            total = times(gain, total)
            for c in range(3):
                image[row, column, c] = int(total[c] + 0.5)

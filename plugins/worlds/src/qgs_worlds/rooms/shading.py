"""Colours of what rays meet: light, the shadows on the floor, textures."""

import math

import numpy as np
from numba import njit

from qgs_worlds.rooms import shapes as s
from qgs_worlds.rooms.intersections import hit, local_point
from qgs_worlds.rooms.raycast import WALLS
from qgs_worlds.rooms.textures import INNER, OPTIONS, mixture, smooth

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


_FLOOR = 4
_FLAT = 0.03  # what lies on the floor and is lower than this shows the floor's shadows
_TAKEN = np.float32(-1)


@njit(**INNER)
def _on_wall(x, y, z, size, face):
    """Inward normal, position in metres and position in [-1, 1] on a wall, floor or ceiling."""
    if face < 2:
        return (1.0 - 2.0 * face, 0.0, 0.0), y, z, 2 * y / size[1], 2 * z / size[2] - 1
    if face < 4:
        return (0.0, 5.0 - 2.0 * face, 0.0), x, z, 2 * x / size[0], 2 * z / size[2] - 1
    return (0.0, 0.0, 9.0 - 2.0 * face), x, y, 2 * x / size[0], 2 * y / size[1]


@njit(**INNER)
def _on_box(x, y, z, h, part):
    """As `_on_wall`, in the box's own frame; part is the axis of the side."""
    if part == 0:
        return (math.copysign(1.0, x), 0.0, 0.0), y, z, y / h[1], z / h[2]
    if part == 1:
        return (0.0, math.copysign(1.0, y), 0.0), x, z, x / h[0], z / h[2]
    return (0.0, 0.0, math.copysign(1.0, z)), x, y, x / h[0], y / h[1]


@njit(**INNER)
def _on_round(x, y, z, h, kind, part):
    """As `_on_box`, for spheres and cylinders; part 1 is a cap."""
    if part == 1:
        return (0.0, 0.0, math.copysign(1.0, z)), x, y, x / h[0], y / h[0]
    angle = math.atan2(y, x)
    normal = (x / h[0], y / h[0], z / h[0] if kind == s.SPHERE else 0.0)
    return normal, angle * h[0], z, angle / math.pi, z / h[2]


@njit(**INNER)
def _surface(shapes, size, code, x, y, z):
    """Index of the texture, world normal and the four texture coordinates of a point."""
    if code < WALLS:
        normal, u, v, p, q = _on_wall(x, y, z, size, code)
        return code, normal, u, v, p, q
    i, part = (code - WALLS) >> 2, (code - WALLS) & 3
    lx, ly, lz = local_point(shapes, i, x, y, z)
    h = (float(shapes[i, 4]), float(shapes[i, 5]), float(shapes[i, 6]))
    if shapes[i, 0] == s.BOX:
        n, u, v, p, q = _on_box(lx, ly, lz, h, part)
    else:
        n, u, v, p, q = _on_round(lx, ly, lz, h, shapes[i, 0], part)
    cos, sin = shapes[i, 7], shapes[i, 8]
    return int(shapes[i, 9]), (cos * n[0] - sin * n[1], sin * n[0] + cos * n[1], n[2]), u, v, p, q


@njit(**INNER)
def _lambert(x, y, z, normal, lights, k):
    """Light from point light k, which falls off gently with the square of the distance."""
    x, y, z = lights[k, 0] - x, lights[k, 1] - y, lights[k, 2] - z
    square = x * x + y * y + z * z
    cosine = (normal[0] * x + normal[1] * y + normal[2] * z) / math.sqrt(square)
    return lights[k, 3] * max(cosine, 0.0) / (1 + 0.12 * square)


@njit(**INNER)
def _edge(distance):
    return 1 - 0.30 / (1 + 6 * distance) ** 2


@njit(**INNER)
def _wall_shadow(x, y, z, size, face):
    """Darkening of walls towards the room's edges."""
    a = 1.0 if face < 2 else _edge(0.5 * size[0] - abs(x))
    b = 1.0 if face == 2 or face == 3 else _edge(0.5 * size[1] - abs(y))
    c = 1.0 if face >= 4 else _edge(z) * _edge(size[2] - z)
    return a * b * c


@njit(**INNER)
def _floor_shadow(floor, x, y, size):
    """Bilinear look-up in the floor's map of shadows, (L, L) over the whole floor."""
    last = floor.shape[0] - 1
    a = min(max((x / size[0] + 0.5) * last, 0.0), last - 1e-6)
    b = min(max((y / size[1] + 0.5) * last, 0.0), last - 1e-6)
    i, j = int(a), int(b)
    a, b = a - i, b - j
    low = floor[i, j] * (1 - b) + floor[i, j + 1] * b
    high = floor[i + 1, j] * (1 - b) + floor[i + 1, j + 1] * b
    return low * (1 - a) + high * a


@njit(**INNER)
def _shadow(floor, size, code, x, y, z, normal):
    if code < WALLS:
        shadow = _wall_shadow(x, y, z, size, code)
        return shadow * _floor_shadow(floor, x, y, size) if code == _FLOOR else shadow
    if z < _FLAT and normal[2] > 0.5:
        return _floor_shadow(floor, x, y, size)
    return 1 - 0.4 / (1 + 3 * z) ** 2


@njit(**INNER)
def _light(lights, floor, size, code, x, y, z, normal):
    """RGB of the light at a point: a bright ceiling above, a warm lamp, a cool window."""
    shadow = _shadow(floor, size, code, x, y, z, normal)
    even = (0.56 - 0.12 * normal[2]) * shadow
    lamp = _lambert(x, y, z, normal, lights, 0) * shadow
    window = _lambert(x, y, z, normal, lights, 1) * shadow
    return (
        even + 1.06 * lamp + 0.96 * window,
        even + lamp + window,
        even + 0.86 * lamp + 1.08 * window,
    )


@njit(**INNER)
def _gather(t, code, i, j, own, samples, step, top, o, rays, points):
    """Write where rays of the pixel at (i, j) hit surface `own`, the mean in row 0; count them."""
    n = 0
    x = y = z = 0.0
    for a in range(samples):
        for b in range(samples):
            if code[i + a, j + b] == own:
                code[i + a, j + b] = _TAKEN
                n += 1
                u, v = (j + b + 0.5) * step, top + (i + a + 0.5) * step
                distance = t[i + a, j + b]
                points[n, 0] = o[0] + distance * (rays[0, 0] + u * rays[0, 1] + v * rays[0, 2])
                points[n, 1] = o[1] + distance * (rays[1, 0] + u * rays[1, 1] + v * rays[1, 2])
                points[n, 2] = o[2] + distance * (rays[2, 0] + u * rays[2, 1] + v * rays[2, 2])
                x, y, z = x + points[n, 0], y + points[n, 1], z + points[n, 2]
    points[0, 0], points[0, 1], points[0, 2] = x * (1 / n), y * (1 / n), z * (1 / n)
    return n


@njit(**INNER)
def _mixed(shapes, size, textures, row, code, points, n, footprint):
    """Mean weights of a texture's second and third colour; a smooth one is looked up in row 0."""
    kind, period, seed = int(textures[row, 0]), textures[row, 1], int(textures[row, 2])
    first, last = (0, 1) if smooth(kind) else (1, n + 1)
    second = third = 0.0
    for k in range(first, last):
        _, _, u, v, p, q = _surface(shapes, size, code, points[k, 0], points[k, 1], points[k, 2])
        b, c = mixture(kind, period, seed, u, v, p, q, footprint)
        second += b * (1 - c)
        third += c
    return second / (last - first), third / (last - first)


@njit(**INNER)
def _channel(textures, row, c, weights, light):
    """Channel c in [0, 1] of a lit texture."""
    a = textures[row, 4 + c]
    value = a + weights[0] * (textures[row, 7 + c] - a) + weights[1] * (textures[row, 10 + c] - a)
    return min(value * (light + (1 - light) * textures[row, 3]), 1.0)


@njit(**INNER)
def _shade(room, floor, code, points, n, footprint):
    """n times the RGB in [0, 1] of a surface seen at rows 1 to n of `points`."""
    shapes, textures, size, lights = room
    x, y, z = points[0, 0], points[0, 1], points[0, 2]
    row, normal, _, _, _, _ = _surface(shapes, size, code, x, y, z)
    weights = _mixed(shapes, size, textures, row, code, points, n, footprint)
    light = _light(lights, floor, size, code, x, y, z, normal)
    return (
        n * _channel(textures, row, 0, weights, light[0]),
        n * _channel(textures, row, 1, weights, light[1]),
        n * _channel(textures, row, 2, weights, light[2]),
    )


@njit(**INNER)
def paint(image, t, code, top, samples, room, floor, c2w, rays):
    """Write image (rows, W, 3) uint8, a band that begins at row `top`, and use `code` up.

    Rays of a pixel that meet one surface share their light, and their texture if it is smooth.
    """
    o = (c2w[0, 3], c2w[1, 3], c2w[2, 3])
    points = np.empty((samples * samples + 1, 3))
    step = 1.0 / samples
    gain = 255.0 * step * step
    spread = step * math.sqrt(rays[0, 1] ** 2 + rays[1, 1] ** 2 + rays[2, 1] ** 2)
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            red = green = blue = 0.0
            i, j = row * samples, column * samples
            for a in range(samples):
                for b in range(samples):
                    own = code[i + a, j + b]
                    if own == _TAKEN:
                        continue
                    n = _gather(t, code, i, j, own, samples, step, top, o, rays, points)
                    footprint = spread * t[i + a, j + b]
                    color = _shade(room, floor, int(own), points, n, footprint)
                    red, green, blue = red + color[0], green + color[1], blue + color[2]
            image[row, column, 0] = int(gain * red + 0.5)
            image[row, column, 1] = int(gain * green + 0.5)
            image[row, column, 2] = int(gain * blue + 0.5)

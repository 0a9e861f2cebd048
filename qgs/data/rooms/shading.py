"""The colour of a pixel: the textures its rays meet, times the light that arrives there."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from qgs.data.rooms import shapes as s
from qgs.data.rooms.intersections import local_point
from qgs.data.rooms.raycast import PARTS, WALLS
from qgs.data.rooms.textures import OPTIONS, SMOOTH, mixture

_BOX, _SPHERE = s.BOX, s.SPHERE
_FLOOR = 4
_FLAT = 0.03  # what lies on the floor and is lower than this shows the floor's shadows
_TAKEN = np.float32(-1)


@njit(**OPTIONS)
def _on_wall(x, y, z, size, face):
    """Inward normal, position in metres and position in [-1, 1] on a wall, floor or ceiling."""
    if face < 2:
        return (1.0 - 2.0 * face, 0.0, 0.0), y, z, 2 * y / size[1], 2 * z / size[2] - 1
    if face < 4:
        return (0.0, 5.0 - 2.0 * face, 0.0), x, z, 2 * x / size[0], 2 * z / size[2] - 1
    return (0.0, 0.0, 9.0 - 2.0 * face), x, y, 2 * x / size[0], 2 * y / size[1]


@njit(**OPTIONS)
def _on_box(x, y, z, h, part):
    """As `_on_wall`, in the box's own frame; part is the axis of the side."""
    if part == 0:
        return (math.copysign(1.0, x), 0.0, 0.0), y, z, y / h[1], z / h[2]
    if part == 1:
        return (0.0, math.copysign(1.0, y), 0.0), x, z, x / h[0], z / h[2]
    return (0.0, 0.0, math.copysign(1.0, z)), x, y, x / h[0], y / h[1]


@njit(**OPTIONS)
def _on_round(x, y, z, h, kind, part):
    """As `_on_box`, for spheres and cylinders; part 1 is a cap."""
    if part == 1:
        return (0.0, 0.0, math.copysign(1.0, z)), x, y, x / h[0], y / h[0]
    angle = math.atan2(y, x)
    normal = (x / h[0], y / h[0], z / h[0] if kind == _SPHERE else 0.0)
    return normal, angle * h[0], z, angle / math.pi, z / h[2]


@njit(**OPTIONS)
def _surface(shapes, size, code, x, y, z):
    """Index of the texture, world normal and the four texture coordinates of a point."""
    if code < WALLS:
        normal, u, v, p, q = _on_wall(x, y, z, size, code)
        return code, normal, u, v, p, q
    i, part = (code - WALLS) // PARTS, (code - WALLS) % PARTS
    lx, ly, lz = local_point(shapes, i, x, y, z)
    h = (float(shapes[i, 4]), float(shapes[i, 5]), float(shapes[i, 6]))
    if shapes[i, 0] == _BOX:
        n, u, v, p, q = _on_box(lx, ly, lz, h, part)
    else:
        n, u, v, p, q = _on_round(lx, ly, lz, h, shapes[i, 0], part)
    cos, sin = shapes[i, 7], shapes[i, 8]
    return int(shapes[i, 9]), (cos * n[0] - sin * n[1], sin * n[0] + cos * n[1], n[2]), u, v, p, q


@njit(**OPTIONS)
def _lambert(x, y, z, normal, light):
    """Light from a point light that falls off gently with the square of the distance."""
    x, y, z = light[0] - x, light[1] - y, light[2] - z
    square = x * x + y * y + z * z
    cosine = (normal[0] * x + normal[1] * y + normal[2] * z) / math.sqrt(square)
    return light[3] * max(cosine, 0.0) / (1 + 0.12 * square)


@njit(**OPTIONS)
def _edge(distance):
    return 1 - 0.30 / (1 + 6 * distance) ** 2


@njit(**OPTIONS)
def _wall_shadow(x, y, z, size, face):
    """Darkening of walls towards the room's edges."""
    a = 1.0 if face < 2 else _edge(0.5 * size[0] - abs(x))
    b = 1.0 if face == 2 or face == 3 else _edge(0.5 * size[1] - abs(y))
    c = 1.0 if face >= 4 else _edge(z) * _edge(size[2] - z)
    return a * b * c


@njit(**OPTIONS)
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


@njit(**OPTIONS)
def _shadow(floor, size, code, x, y, z, normal):
    if code < WALLS:
        shadow = _wall_shadow(x, y, z, size, code)
        return shadow * _floor_shadow(floor, x, y, size) if code == _FLOOR else shadow
    if z < _FLAT and normal[2] > 0.5:
        return _floor_shadow(floor, x, y, size)
    return 1 - 0.4 / (1 + 3 * z) ** 2


@njit(**OPTIONS)
def _light(room, floor, code, x, y, z, normal):
    """RGB of the light at a point: a bright ceiling above, a warm lamp, a cool window."""
    _, _, size, lights = room
    shadow = _shadow(floor, size, code, x, y, z, normal)
    even = (0.40 + 0.16 * normal[2]) * shadow
    lamp = _lambert(x, y, z, normal, lights[0]) * shadow
    window = _lambert(x, y, z, normal, lights[1]) * shadow
    return (
        even + 1.06 * lamp + 0.96 * window,
        even + lamp + window,
        even + 0.86 * lamp + 1.08 * window,
    )


@njit(**OPTIONS)
def _mean_texture(room, texture, code, points, members, footprint):
    """Mean weights of a texture's second and third colour over `points` (members, 3)."""
    shapes, _, size, _ = room
    kind, period, seed = int(texture[0]), texture[1], int(texture[2])
    second = third = 0.0
    for k in range(members):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        _, _, u, v, p, q = _surface(shapes, size, code, x, y, z)
        m, n = mixture(kind, period, seed, u, v, p, q, footprint)
        second += m * (1 - n)
        third += n
    return second / members, third / members


@njit(**OPTIONS)
def _gather(t, code, i, j, samples, v, u, origin, rays, points):
    """Write where those rays of a pixel hit that meet its ray (i, j)'s surface; their number.

    The last row of `points` gets the mean. The rays are marked as taken.
    """
    own, n = code[i, j], 0
    for a in range(samples):
        for b in range(samples):
            ia, jb = i - i % samples + a, j - j % samples + b
            if code[ia, jb] == own:
                code[ia, jb] = _TAKEN
                du, dv = u + (b + 0.5) / samples, v + (a + 0.5) / samples
                for c in range(3):
                    d = rays[c, 0] + du * rays[c, 1] + dv * rays[c, 2]
                    points[n, c] = origin[c] + t[ia, jb] * d
                n += 1
    for c in range(3):
        points[-1, c] = points[:n, c].sum() / n
    return n


@njit(**OPTIONS)
def paint(image, t, code, top, samples, room, floor, c2w, rays):
    """Write image (rows, W, 3) uint8, a band that begins at row `top`, and use `code` up.

    Rays of a pixel that meet one surface share their light, and their texture if it is smooth.
    """
    shapes, textures, size, _ = room
    points = np.empty((samples * samples + 1, 3))
    total = np.empty(3)
    spread = math.sqrt(rays[0, 1] ** 2 + rays[1, 1] ** 2 + rays[2, 1] ** 2) / samples
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            total[:] = 0.5
            for k in range(samples * samples):
                i, j = row * samples + k // samples, column * samples + k % samples
                own = int(code[i, j])
                if own < 0:
                    continue
                n = _gather(t, code, i, j, samples, top + row, column, c2w[:3, 3], rays, points)
                x, y, z = points[-1, 0], points[-1, 1], points[-1, 2]
                index, normal, _, _, _, _ = _surface(shapes, size, own, x, y, z)
                texture = textures[index]
                smooth = SMOOTH[int(texture[0])]
                m = _mean_texture(
                    room,
                    texture,
                    own,
                    points[-1:] if smooth else points,
                    1 if smooth else n,
                    t[i, j] * spread,
                )
                light = _light(room, floor, own, x, y, z, normal)
                gain = 255.0 * n / (samples * samples)
                for c in range(3):
                    a, b, e = texture[4 + c], texture[7 + c], texture[10 + c]
                    value = a + m[0] * (b - a) + m[1] * (e - a)
                    lit = light[c] + (1 - light[c]) * texture[3]
                    total[c] += gain * min(lit * value, 1.0)
            for c in range(3):
                image[row, column, c] = int(total[c])

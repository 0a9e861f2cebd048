"""Colours of what rays meet: light with shadows and occlusion, highlights, sky and fog."""

import math

import numpy as np
from numba import njit

from qgs_worlds import rows as r
from qgs_worlds.intervals import height_at, hollow, local_point
from qgs_worlds.kernels import BORROWING
from qgs_worlds.occlusion import surroundings, visible
from qgs_worlds.raycast import SKY
from qgs_worlds.rooms.intersections import ONE, ZERO
from qgs_worlds.rooms.textures import OPTIONS
from qgs_worlds.shadows import lit
from qgs_worlds.textures import color, noise

_TAKEN = np.float32(-2)
_LIFT = 2e-3  # metres above a surface where its light is looked up


@njit(**BORROWING)
def _unit(x, y, z):
    scale = 1.0 / math.sqrt(x * x + y * y + z * z + 1e-20)
    return x * scale, y * scale, z * scale


@njit(**BORROWING)
def _largest(x, y, z):
    """The axis along which a vector is longest."""
    if abs(x) >= abs(y) and abs(x) >= abs(z):
        return 0
    return 1 if abs(y) >= abs(z) else 2


@njit(**BORROWING)
def _on_axis(axis, x, y, z, h):
    """Normal of the cube's face across an axis, position on it in metres, and its number."""
    if axis == 0:
        return (math.copysign(1.0, x), 0.0, 0.0), y * h[1], z * h[2], (1 if x > 0 else 0)
    if axis == 1:
        return (0.0, math.copysign(1.0, y), 0.0), x * h[0], z * h[2], (3 if y > 0 else 2)
    return (0.0, 0.0, math.copysign(1.0, z)), x * h[0], y * h[1], (5 if z > 0 else 4)


@njit(**BORROWING)
def _on_primitive(kind, extra, heights, face, x, y, z, h):
    """As `_on_axis` for a primitive of any kind, at a point and a face of it."""
    if kind == r.BOX:
        return _on_axis(face, x, y, z, h)
    if kind == r.ELLIPSOID:
        _, u, v, _ = _on_axis(_largest(x / h[0], y / h[1], z / h[2]), x, y, z, h)
        return (x, y, z), u, v, 0
    if kind == r.HEIGHT:
        if face == 1:
            return _on_axis(_largest(x, y, z), x, y, z, h)
        s, field = np.float32(2.0 / (heights.shape[1] - 1)), heights[int(extra)]
        slope_x = height_at(field, x + s, y) - height_at(field, x - s, y)
        slope_y = height_at(field, x, y + s) - height_at(field, x, y - s)
        return (-slope_x / (2 * s), -slope_y / (2 * s), 1.0), x * h[0], y * h[1], 0
    across, angle = math.sqrt(x * x + y * y), math.atan2(y, x)
    if kind == r.TORUS:
        ring = 1.0 - extra
        w = (across - ring) / max(across, 1e-6)
        return (
            (w * x, w * y, z),
            angle * ring * h[0],
            math.atan2(z, across - ring) * extra * h[0],
            0,
        )
    if kind == r.CAPSULE:
        return (x, y, z - min(max(z, -extra), extra)), angle * h[0], z * h[2], 0
    if face == 1:
        return (0.0, 0.0, math.copysign(1.0, z)), x * h[0], y * h[1], 1
    return (x, y, 0.5 * (1 - extra) * across), angle * h[0], z * h[2], 0


@njit(**BORROWING)
def _surface(shapes, heights, code, place):
    """Index of the texture, world normal and texture coordinates of a point of a surface."""
    i, part = code >> 3, code & 7
    cut = part >= 3
    p, face = (r.PRIMITIVE_FIELDS, part - 3) if cut else (0, part)
    x, y, z = np.float32(place[0]), np.float32(place[1]), np.float32(place[2])
    lx, ly, lz = local_point(shapes, i, p, x, y, z)
    h = (shapes[i, p + r.HALF], shapes[i, p + r.HALF + 1], shapes[i, p + r.HALF + 2])
    kind, extra = int(shapes[i, p]), shapes[i, p + 1]
    n, u, v, side = _on_primitive(kind, extra, heights, face, lx, ly, lz, h)
    m, sign = p + r.MATRIX, -1.0 if cut else 1.0
    normal = _unit(
        sign * (shapes[i, m] * n[0] + shapes[i, m + 3] * n[1] + shapes[i, m + 6] * n[2]),
        sign * (shapes[i, m + 1] * n[0] + shapes[i, m + 4] * n[1] + shapes[i, m + 7] * n[2]),
        sign * (shapes[i, m + 2] * n[0] + shapes[i, m + 5] * n[1] + shapes[i, m + 8] * n[2]),
    )
    row = int(shapes[i, r.TEXTURE]) + min(side, int(shapes[i, r.FACES]) - 1)
    scale = 1.0 / shapes[i, r.SCALE]
    return (int(shapes[i, r.CUT_TEXTURE]) if cut else row), normal, u * scale, v * scale


@njit(**BORROWING)
def _sky(air, lights, view):
    """RGB of the sky in a direction: a gradient, clouds and a glow about the sun."""
    x, y, z = view
    up = math.sqrt(max(z, 0.0))
    cloud = 0.0
    if air[r.CLOUDS] > 0 and z > 0.02:
        a, b, seed = 1.2 * x / (z + 0.15), 1.2 * y / (z + 0.15), int(air[r.AIR_SEED])
        weight = 1.0
        for octave in range(3):
            cloud += weight * noise(r.VALUE, a, b, seed + octave)
            a, b, weight = 2.03 * a + 5.1, 2.03 * b, 0.55 * weight
        cloud = min(max(2.0 * cloud + air[r.CLOUDS] - 0.5, 0.0), 1.0) * min(8 * z, 1.0)
    glow = 0.0
    if lights.shape[0] > 0 and lights[0, r.LAMP] == 0:
        near = x * lights[0, r.PLACE] + y * lights[0, r.PLACE + 1] + z * lights[0, r.PLACE + 2]
        near = max(near, 0.0) ** 2
        near *= near
        near *= near
        glow = 0.5 * near * near
    white = 1.3 * max(air[r.HORIZON], air[r.HORIZON + 1], air[r.HORIZON + 2])
    red = air[r.HORIZON] + up * (air[r.ZENITH] - air[r.HORIZON])
    green = air[r.HORIZON + 1] + up * (air[r.ZENITH + 1] - air[r.HORIZON + 1])
    blue = air[r.HORIZON + 2] + up * (air[r.ZENITH + 2] - air[r.HORIZON + 2])
    return (
        red + cloud * (white - red) + glow * white,
        green + cloud * (white - green) + 0.9 * glow * white,
        blue + cloud * (white - blue) + 0.7 * glow * white,
    )


@njit(**BORROWING)
def _light(lights, shadows, k, own, place, normal, view, open_, shine):
    """How much of light k comes from a point by reflection: evenly, and as a highlight."""
    lamp = lights[k, r.LAMP]
    dx = lights[k, r.PLACE] - lamp * place[0]
    dy = lights[k, r.PLACE + 1] - lamp * place[1]
    dz = lights[k, r.PLACE + 2] - lamp * place[2]
    square = dx * dx + dy * dy + dz * dz
    near = 1.0 / math.sqrt(square)
    cosine = (normal[0] * dx + normal[1] * dy + normal[2] * dz) * near
    if cosine <= 0:
        return 0.0, 0.0
    strength = 1.0 / (1.0 + lamp * 0.25 * square)
    if lights[k, r.SHADOWS] > 0:
        x, y, z = place
        x, y, z = x + _LIFT * normal[0], y + _LIFT * normal[1], z + _LIFT * normal[2]
        strength *= lit(shadows, lights, k, own, x, y, z)
    else:
        strength *= open_
    if shine <= 0:
        return strength * cosine, 0.0
    hx, hy, hz = _unit(dx * near - view[0], dy * near - view[1], dz * near - view[2])
    half = max(hx * normal[0] + hy * normal[1] + hz * normal[2], 0.0)
    return strength * cosine, strength * half**shine


@njit(**BORROWING)
def _shade(world, around, code, place, view, footprint, distance):
    """RGB of a surface seen at a point from direction `view`."""
    shapes, heights, textures, lights, air, shadows = world
    shape = code >> 3
    row, normal, u, v = _surface(shapes, heights, code, place)
    own = -1 if hollow(shapes, shape) else shape
    facing = -(normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2])
    slant = footprint / math.sqrt(max(facing, 0.06))
    albedo = color(textures, row, u, v, slant / shapes[shape, r.SCALE])
    open_ = visible(shapes, around, shape, place, normal, air[r.OCCLUSION], air[r.REACH], footprint)
    up, gloss = 0.5 + 0.5 * normal[2], textures[row, r.SPECULAR]
    red = albedo[0] * open_ * (air[r.BELOW] + up * (air[r.ABOVE] - air[r.BELOW]))
    green = albedo[1] * open_ * (air[r.BELOW + 1] + up * (air[r.ABOVE + 1] - air[r.BELOW + 1]))
    blue = albedo[2] * open_ * (air[r.BELOW + 2] + up * (air[r.ABOVE + 2] - air[r.BELOW + 2]))
    sharp = textures[row, r.SHINE] if gloss > 0 else 0.0
    for k in range(lights.shape[0]):
        even, high = _light(lights, shadows, k, own, place, normal, view, open_, sharp)
        red += (albedo[0] * even + gloss * high) * lights[k, r.COLOR]
        green += (albedo[1] * even + gloss * high) * lights[k, r.COLOR + 1]
        blue += (albedo[2] * even + gloss * high) * lights[k, r.COLOR + 2]
    mist = 1.0 - 1.0 / (1.0 + air[r.FOG] * distance)
    return (
        red + mist * (air[r.HORIZON] - red),
        green + mist * (air[r.HORIZON + 1] - green),
        blue + mist * (air[r.HORIZON + 2] - blue),
    )


@njit(**BORROWING)
def _gather(t, code, i, j, own, samples):
    """Take the rays of the pixel at (i, j) that hit surface `own`: their number and means.

    Of their t, and of their columns and rows within the pixel, which t weighs.
    """
    n = 0
    t_sum = u_sum = v_sum = ZERO
    for a in range(samples):
        for b in range(samples):
            if code[i + a, j + b] == own:
                code[i + a, j + b] = _TAKEN
                n += 1
                distance = t[i + a, j + b] if own != SKY else ONE
                t_sum += distance
                u_sum += distance * b
                v_sum += distance * a
    return n, t_sum / n, u_sum / t_sum, v_sum / t_sum


@njit(**OPTIONS)
def paint(image, t, code, top, samples, world, c2w, rays):
    """Write image (rows, W, 3) float32, a band that begins at row `top`, and use `code` up.

    Values are linear in light. Rays of a pixel that meet one surface are shaded at their mean.
    """
    _paint(image, t, code, top, samples, world, surroundings(world[0]), c2w, rays)


@njit(**BORROWING)
def _paint(image, t, code, top, samples, world, around, c2w, rays):
    ox, oy, oz = c2w[0, 3], c2w[1, 3], c2w[2, 3]
    lights, air = world[3], world[4]
    step = 1.0 / samples
    spread = math.sqrt(rays[0, 1] ** 2 + rays[1, 1] ** 2 + rays[2, 1] ** 2)
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            red = green = blue = 0.0
            i, j = row * samples, column * samples
            for a in range(samples):
                for b in range(samples):
                    own = code[i + a, j + b]
                    if own == _TAKEN:
                        continue
                    n, depth, u, v = _gather(t, code, i, j, own, samples)
                    u, v = column + (u + 0.5) * step, top + row + (v + 0.5) * step
                    dx = rays[0, 0] + u * rays[0, 1] + v * rays[0, 2]
                    dy = rays[1, 0] + u * rays[1, 1] + v * rays[1, 2]
                    dz = rays[2, 0] + u * rays[2, 1] + v * rays[2, 2]
                    long = math.sqrt(dx * dx + dy * dy + dz * dz)
                    view = (dx / long, dy / long, dz / long)
                    if own == SKY:
                        seen = _sky(air, lights, view)
                    else:
                        place = (ox + depth * dx, oy + depth * dy, oz + depth * dz)
                        seen = _shade(
                            world, around, int(own), place, view, spread * depth, depth * long
                        )
                    red, green, blue = red + n * seen[0], green + n * seen[1], blue + n * seen[2]
            part = step * step
            image[row, column, 0], image[row, column, 1] = part * red, part * green
            image[row, column, 2] = part * blue

"""Colours of what rays meet: light with shadows and occlusion, highlights, sky and fog."""

import math

import numpy as np
from numba import njit
from qgs_rooms.intersections import ONE, ZERO
from qgs_rooms.textures import INNER

from qgs_worlds import rows as r
from qgs_worlds.intervals import height_at, local, local_point, shape_hit
from qgs_worlds.raycast import SKY
from qgs_worlds.textures import color, noise

_TAKEN = np.float32(-2)
_LIFT = 2e-3  # metres by which rays to lights start above a surface
_SHADES, _NEAR = np.float32(1), np.float32(2)


@njit(**INNER)
def _unit(x, y, z):
    scale = 1.0 / math.sqrt(x * x + y * y + z * z + 1e-20)
    return x * scale, y * scale, z * scale


@njit(**INNER)
def _largest(x, y, z):
    """The axis along which a vector is longest."""
    if abs(x) >= abs(y) and abs(x) >= abs(z):
        return 0
    return 1 if abs(y) >= abs(z) else 2


@njit(**INNER)
def _on_axis(axis, x, y, z, h):
    """Normal of the cube's face across an axis, position on it in metres, and its number."""
    if axis == 0:
        return (math.copysign(1.0, x), 0.0, 0.0), y * h[1], z * h[2], (1 if x > 0 else 0)
    if axis == 1:
        return (0.0, math.copysign(1.0, y), 0.0), x * h[0], z * h[2], (3 if y > 0 else 2)
    return (0.0, 0.0, math.copysign(1.0, z)), x * h[0], y * h[1], (5 if z > 0 else 4)


@njit(**INNER)
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
        s, field = np.float32(0.6 / heights.shape[1]), heights[int(extra)]
        slope_x = height_at(field, x + s, y) - height_at(field, x - s, y)
        slope_y = height_at(field, x, y + s) - height_at(field, x, y - s)
        return (-slope_x / (2 * s), -slope_y / (2 * s), 1.0), x * h[0], y * h[1], 0
    across, angle = math.sqrt(x * x + y * y), math.atan2(y, x)
    if kind == r.TORUS:
        ring = 1.0 - extra
        w = (across - ring) / max(across, 1e-6)
        return (w * x, w * y, z), angle * ring * h[0], math.atan2(z, across - ring) * extra * h[0], 0
    if kind == r.CAPSULE:
        return (x, y, z - min(max(z, -extra), extra)), angle * h[0], z * h[2], 0
    if face == 1:
        return (0.0, 0.0, math.copysign(1.0, z)), x * h[0], y * h[1], 1
    return (x, y, 0.5 * (1 - extra) * across), angle * h[0], z * h[2], 0


@njit(**INNER)
def _surface(shapes, heights, code, x, y, z):
    """Index of the texture, world normal and texture coordinates of a point of a surface."""
    i, part = code >> 3, code & 7
    cut = part >= 3
    p, face = (r.PRIMITIVE_FIELDS, part - 3) if cut else (0, part)
    lx, ly, lz = local_point(shapes, i, p, np.float32(x), np.float32(y), np.float32(z))
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


@njit(**INNER)
def _candidates(spheres, near, o, d, limit, reach, pad):
    """Write into `near` which shapes' bounding spheres a ray to a light meets, or are in reach."""
    ox, oy, oz = np.float32(o[0]), np.float32(o[1]), np.float32(o[2])
    dx, dy, dz = np.float32(d[0]), np.float32(d[1]), np.float32(d[2])
    limit, reach, pad = np.float32(limit), np.float32(reach), np.float32(pad)
    for i in range(near.shape[0]):
        x, y, z = spheres[0, i] - ox, spheres[1, i] - oy, spheres[2, i] - oz
        square, along, size = x * x + y * y + z * z, x * dx + y * dy + z * dz, spheres[3, i]
        met = (square - along * along < (size + pad) * (size + pad)) & (along > -size)
        met = met & (along - size < limit)
        close = square < (size + reach) * (size + reach)
        near[i] = (_SHADES if met else ZERO) + (_NEAR if close else ZERO)


@njit(**INNER)
def _lit(shapes, heights, near, points, n, normal, light, lamp):
    """The share of n points from which a light is seen."""
    blocked, count = 0, near.shape[0]
    for i in range(count):
        if near[i] != _SHADES and near[i] != _SHADES + _NEAR:
            continue
        for k in range(1, n + 1):
            bit = 1 << k
            if blocked & bit:
                continue
            x = points[k, 0] + _LIFT * normal[0]
            y = points[k, 1] + _LIFT * normal[1]
            z = points[k, 2] + _LIFT * normal[2]
            o = (np.float32(x), np.float32(y), np.float32(z))
            dx, dy, dz = light[0] - lamp * x, light[1] - lamp * y, light[2] - lamp * z
            d = (np.float32(dx), np.float32(dy), np.float32(dz))
            t, _ = shape_hit(shapes, heights, i, o, d)
            if t < (0.98 if lamp else np.inf):
                blocked |= bit
        if blocked == (2 << n) - 2:
            return 0.0
    count = 0
    for k in range(1, n + 1):
        count += blocked >> k & 1
    return 1.0 - count / n


@njit(**INNER)
def _open(shapes, near, own, x, y, z, normal, strength, reach):
    """How much of the ambient light reaches a point, by distances to boxes around near shapes."""
    first = second = reach
    for i in range(near.shape[0]):
        if near[i] < _NEAR or i == own:
            continue
        h = (shapes[i, r.HALF], shapes[i, r.HALF + 1], shapes[i, r.HALF + 2])
        a = local_point(shapes, i, 0, np.float32(x), np.float32(y), np.float32(z))
        b = local(shapes, i, 0, np.float32(normal[0]), np.float32(normal[1]), np.float32(normal[2]))
        for step in range(2):
            up = np.float32((0.25 if step == 0 else 0.8) * reach)
            square = ZERO
            for axis in range(3):
                away = abs(a[axis] + up * b[axis]) - shapes[i, r.EXTENT + axis]
                square += (max(away, ZERO) * h[axis]) ** 2
            distance = math.sqrt(square)
            first = min(first, distance) if step == 0 else first
            second = min(second, distance) if step == 1 else second
    hidden = 0.5 * max(1 - first / (0.25 * reach), 0.0) + 0.5 * max(1 - second / (0.8 * reach), 0.0)
    return 1.0 - strength * hidden


@njit(**INNER)
def _sky(air, lights, x, y, z):
    """RGB of the sky in a direction: a gradient, clouds and a glow about the sun."""
    x, y, z = _unit(x, y, z)
    up = math.sqrt(max(z, 0.0))
    cloud = 0.0
    if air[r.CLOUDS] > 0 and z > 0.02:
        a, b, seed = 1.2 * x / (z + 0.15), 1.2 * y / (z + 0.15), int(air[r.AIR_SEED])
        for octave in range(4):
            cloud += 0.55**octave * noise(r.VALUE, a, b, seed + octave)
            a, b = 2.03 * a + 5.1, 2.03 * b
        cloud = min(max(2.0 * cloud + air[r.CLOUDS] - 0.5, 0.0), 1.0) * min(8 * z, 1.0)
    glow = 0.0
    if lights.shape[0] > 0 and lights[0, r.LAMP] == 0:
        near = x * lights[0, r.PLACE] + y * lights[0, r.PLACE + 1] + z * lights[0, r.PLACE + 2]
        glow = 0.5 * max(near, 0.0) ** 32
    white = 1.3 * max(air[r.HORIZON], air[r.HORIZON + 1], air[r.HORIZON + 2])
    red = air[r.HORIZON] + up * (air[r.ZENITH] - air[r.HORIZON])
    green = air[r.HORIZON + 1] + up * (air[r.ZENITH + 1] - air[r.HORIZON + 1])
    blue = air[r.HORIZON + 2] + up * (air[r.ZENITH + 2] - air[r.HORIZON + 2])
    return (
        red + cloud * (white - red) + glow * white,
        green + cloud * (white - green) + 0.9 * glow * white,
        blue + cloud * (white - blue) + 0.7 * glow * white,
    )


@njit(**INNER)
def _shade(world, spheres, near, code, points, n, view, footprint, distance):
    """RGB of a surface seen at rows 1 to n of `points`, their mean in row 0, from `view`."""
    shapes, heights, textures, lights, air = world
    x, y, z = points[0, 0], points[0, 1], points[0, 2]
    row, normal, u, v = _surface(shapes, heights, code, x, y, z)
    facing = -(normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2])
    slant = footprint / math.sqrt(max(facing, 0.06))
    albedo = color(textures, row, u, v, slant / shapes[code >> 3, r.SCALE])
    above = 0.5 + 0.5 * normal[2]
    red = green = blue = shine = 0.0
    hidden = 1.0
    for k in range(lights.shape[0]):
        lamp = lights[k, r.LAMP]
        dx = lights[k, r.PLACE] - lamp * x
        dy = lights[k, r.PLACE + 1] - lamp * y
        dz = lights[k, r.PLACE + 2] - lamp * z
        far = math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / far, dy / far, dz / far
        cosine = normal[0] * dx + normal[1] * dy + normal[2] * dz
        if k == 0:  # the ambient occlusion shares the search for shapes
            start = (x, y, z)
            limit = far if lamp else 1e9
            _candidates(spheres, near, start, (dx, dy, dz), limit, air[r.REACH], 2 * footprint)
            hidden = _open(
                shapes, near, code >> 3, x, y, z, normal, air[r.OCCLUSION], air[r.REACH]
            )
        if cosine <= 0:
            continue
        strength = cosine / (1 + lamp * 0.25 * far * far)
        if lights[k, r.SHADOWS] > 0:
            if k > 0:
                limit = far if lamp else 1e9
                _candidates(spheres, near, (x, y, z), (dx, dy, dz), limit, 0.0, 2 * footprint)
            place = (lights[k, r.PLACE], lights[k, r.PLACE + 1], lights[k, r.PLACE + 2])
            strength *= _lit(shapes, heights, near, points, n, normal, place, lamp)
        else:
            strength *= hidden
        red += strength * lights[k, r.COLOR]
        green += strength * lights[k, r.COLOR + 1]
        blue += strength * lights[k, r.COLOR + 2]
        if textures[row, r.SPECULAR] > 0:
            hx, hy, hz = _unit(dx - view[0], dy - view[1], dz - view[2])
            half = max(hx * normal[0] + hy * normal[1] + hz * normal[2], 0.0)
            shine += strength / cosine * half ** textures[row, r.SHINE]
    shine *= textures[row, r.SPECULAR]
    glow, mist = textures[row, r.EMISSION], 1.0 - math.exp(-air[r.FOG] * distance)
    low = air[r.BELOW], air[r.BELOW + 1], air[r.BELOW + 2]
    red += hidden * (low[0] + above * (air[r.ABOVE] - low[0])) + glow
    green += hidden * (low[1] + above * (air[r.ABOVE + 1] - low[1])) + glow
    blue += hidden * (low[2] + above * (air[r.ABOVE + 2] - low[2])) + glow
    red, green, blue = red * albedo[0] + shine, green * albedo[1] + shine, blue * albedo[2] + shine
    return (
        red + mist * (air[r.HORIZON] - red),
        green + mist * (air[r.HORIZON + 1] - green),
        blue + mist * (air[r.HORIZON + 2] - blue),
    )


@njit(**INNER)
def _gather(t, code, i, j, own, samples, top, o, rays, points):
    """Write where rays of the pixel at (i, j) hit surface `own`, the mean in row 0; count them."""
    n, step = 0, 1.0 / samples
    x = y = z = 0.0
    for a in range(samples):
        for b in range(samples):
            if code[i + a, j + b] == own:
                code[i + a, j + b] = _TAKEN
                n += 1
                u, v = (j + b + 0.5) * step, top + (i + a + 0.5) * step
                distance = t[i + a, j + b] if own != SKY else 1.0
                points[n, 0] = o[0] + distance * (rays[0, 0] + u * rays[0, 1] + v * rays[0, 2])
                points[n, 1] = o[1] + distance * (rays[1, 0] + u * rays[1, 1] + v * rays[1, 2])
                points[n, 2] = o[2] + distance * (rays[2, 0] + u * rays[2, 1] + v * rays[2, 2])
                x, y, z = x + points[n, 0], y + points[n, 1], z + points[n, 2]
    points[0, 0], points[0, 1], points[0, 2] = x / n, y / n, z / n
    return n


@njit(**INNER)
def paint(image, t, code, top, samples, world, c2w, rays):
    """Write image (rows, W, 3) float32, a band that begins at row `top`, and use `code` up.

    Values are linear in light. Rays of a pixel that meet one surface share its texture and light,
    but for shadows, which are sharp.
    """
    o = (c2w[0, 3], c2w[1, 3], c2w[2, 3])
    shapes, _, _, lights, air = world
    spheres = np.ascontiguousarray(shapes[:, r.SPHERE : r.SPHERE + 4].T)
    near = np.empty(shapes.shape[0], np.float32)
    points = np.empty((samples * samples + 1, 3))
    part = 1.0 / (samples * samples)
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
                    depth = t[i + a, j + b]
                    n = _gather(t, code, i, j, own, samples, top, o, rays, points)
                    dx, dy, dz = points[0, 0] - o[0], points[0, 1] - o[1], points[0, 2] - o[2]
                    if own == SKY:
                        seen = _sky(air, lights, dx, dy, dz)
                    else:
                        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
                        view = (dx / distance, dy / distance, dz / distance)
                        seen = _shade(
                            world, spheres, near, int(own), points, n, view, spread * depth, distance
                        )
                    red += n * part * seen[0]
                    green += n * part * seen[1]
                    blue += n * part * seen[2]
            image[row, column, 0], image[row, column, 1] = red, green
            image[row, column, 2] = blue

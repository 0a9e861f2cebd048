"""Colours of surfaces in worlds: light with shadows and occlusion, highlights, sky and fog."""

import math

import numpy as np

from qgs.kernels import kernel
from qgs_worlds.caster import tables as s
from qgs_worlds.caster.intervals import ONE, ZERO, height_at, hollow, local_point
from qgs_worlds.caster.raycast import SKY
from qgs_worlds.caster.shadows import lit, surroundings, visible
from qgs_worlds.caster.textures import color, noise
from qgs_worlds.caster.vectors import (
    along,
    dot,
    inner,
    longest,
    minus,
    mix,
    narrow,
    over,
    product,
    times,
    triple,
    unit,
)

TAKEN = np.float32(-2)
# Height in metres above a surface at which its light is evaluated, to avoid self-shadowing.
_LIFT = 2e-3


@inner
def on_axis(axis, p, unit):
    """Return normal, texture coordinates u and v, and face number of a point on a box.

    axis: axis of the face's normal, 0 to 2. p: the point in the box's frame. unit: metres per unit
    of this frame, on each axis.
    """
    x, y, z = p
    if axis == 0:
        return (math.copysign(1.0, x), 0.0, 0.0), y * unit[1], z * unit[2], (1 if x > 0 else 0)
    if axis == 1:
        return (0.0, math.copysign(1.0, y), 0.0), x * unit[0], z * unit[2], (3 if y > 0 else 2)
    return (0.0, 0.0, math.copysign(1.0, z)), x * unit[0], y * unit[1], (5 if z > 0 else 4)


@inner
def _on_relief(field, p, unit):
    x, y, _ = p
    step = np.float32(2.0 / (field.shape[0] - 1))
    slope_x = height_at(field, x + step, y) - height_at(field, x - step, y)
    slope_y = height_at(field, x, y + step) - height_at(field, x, y - step)
    normal = (-slope_x / (2 * step), -slope_y / (2 * step), 1.0)
    return normal, x * unit[0], y * unit[1], 0


@inner
def _on_primitive(primitive, heights, face, p):
    """Return normal, texture coordinates u and v, and face number of a point on a primitive.

    face: number of the face that the ray hit. p: the point in the primitive's frame.
    """
    kind = primitive.kind
    extra = primitive.extra
    unit = triple(primitive.unit)
    x, y, z = p
    if kind == s.BOX:
        return on_axis(face, p, unit)
    if kind == s.ELLIPSOID:
        _, u, v, _ = on_axis(longest((x / unit[0], y / unit[1], z / unit[2])), p, unit)
        return p, u, v, 0
    if kind == s.HEIGHT:
        if face == 1:
            return on_axis(longest(p), p, unit)
        return _on_relief(heights[int(extra)], p, unit)
    across = math.sqrt(x * x + y * y)
    angle = math.atan2(y, x)
    if kind == s.TORUS:
        ring = 1.0 - extra
        w = (across - ring) / max(across, 1e-6)
        v = math.atan2(z, across - ring) * extra * unit[0]
        return (w * x, w * y, z), angle * ring * unit[0], v, 0
    if kind == s.CAPSULE:
        from_segment = (x, y, z - min(max(z, -extra), extra))
        return from_segment, angle * unit[0], z * unit[2], 0
    if face == 1:
        normal, u, v, _ = on_axis(2, p, unit)
        return normal, u, v, 1
    return (x, y, 0.5 * (1 - extra) * across), angle * unit[0], z * unit[2], 0


@inner
def to_world(primitive, n):
    """Turn the normal n from a primitive's frame to the world frame, without normalising it."""
    axes = primitive.axes
    # `axes` leads into the frame, so its transpose leads normals out of it
    return dot(axes[:, 0], n), dot(axes[:, 1], n), dot(axes[:, 2], n)


@inner
def surface(shape, heights, part, place):
    """Return texture index, world normal and texture coordinates u, v of a point on a shape.

    part: number of the face. Numbers of 3 and above are faces of `shape.cut`, the primitive that is
    removed from the shape. place: the point in the world frame.
    """
    cut = part >= 3
    primitive = shape.cut if cut else shape.body
    face = part - 3 if cut else part
    p = local_point(primitive, narrow(place))
    n, u, v, side = _on_primitive(primitive, heights, face, p)
    normal = unit(times(-1.0 if cut else 1.0, to_world(primitive, n)))
    # a shape with one texture has it on all sides
    row = shape.cut_texture if cut else shape.texture + min(side, shape.faces - 1)
    scale = 1.0 / shape.scale
    return row, normal, u * scale, v * scale


@inner
def _clouds(air, x, y, z):
    """Return how much clouds cover the sky in the direction (x, y, z): 0 (clear) to 1 (overcast).

    The clouds are noise on a high plane.
    """
    if air.clouds <= 0 or z <= 0.02:
        return 0.0
    # the summand limits how fine the clouds are at the horizon
    a = 1.2 * x / (z + 0.15)
    b = 1.2 * y / (z + 0.15)
    cloud = 0.0
    weight = 1.0
    for octave in range(3):
        cloud += weight * noise(s.VALUE, a, b, air.seed + octave)
        a = 2.03 * a + 5.1
        b = 2.03 * b
        weight = 0.55 * weight
    return min(max(2.0 * cloud + air.clouds - 0.5, 0.0), 1.0) * min(8 * z, 1.0)


@inner
def _glow(lights, view):
    """Return the brightness of the glow around the sun in direction `view`.

    It is half of the 16th power of the cosine between `view` and the sun; without a sun, it is 0.
    """
    if lights.shape[0] == 0 or lights[0].lamp > 0:
        return 0.0
    return 0.5 * max(dot(view, lights[0].place), 0.0) ** 16


@inner
def _sky(air, lights, view):
    """Return the RGB of the sky in direction `view`: a gradient, clouds and a glow near the sun."""
    x, y, z = view
    cloud = _clouds(air, x, y, z)
    glow = _glow(lights, view)
    white = 1.3 * max(air.horizon[0], air.horizon[1], air.horizon[2])
    clear = mix(air.horizon, air.zenith, math.sqrt(max(z, 0.0)))
    # the sun is slightly yellow
    glow = (glow * white, 0.9 * glow * white, 0.7 * glow * white)
    return along(glow, 1.0, mix(clear, (white, white, white), cloud))


@inner
def _light(light, shadows, own, place, normal, view, open_, shine):
    """Return two factors by which a point reflects one light: diffuse light and highlight.

    own: index of the shape; -1 lets the shape cast shadows on itself. view: direction from the
    camera. open_: fraction of ambient light that reaches the point; it also dims a light that has
    no shadow map. shine: exponent of the highlight; 0 for none.
    """
    toward = minus(light.place, times(light.lamp, place))
    square = dot(toward, toward)
    near = 1.0 / math.sqrt(square)
    cosine = dot(normal, toward) * near
    if cosine <= 0:
        return 0.0, 0.0
    # lamps are not points, so near them light falls off less than the square
    strength = 1.0 / (1.0 + light.lamp * 0.25 * square)
    if light.shadows > 0:
        strength *= lit(shadows, light, own, along(place, _LIFT, normal))
    else:
        strength *= open_
    if shine <= 0:
        return strength * cosine, 0.0
    # Blinn's highlight
    half = max(dot(unit(minus(times(near, toward), view)), normal), 0.0)
    return strength * cosine, strength * half**shine


@inner
def _shade(world, around, code, place, view, footprint, distance):
    """Return the RGB, in linear light, of a surface seen from the camera.

    around: cache from `surroundings`, which `visible` updates. code: face code of the surface.
    place: point on the surface. view: direction from the camera. footprint: distance between
    neighbouring pixels at the point. distance: from the camera to the point. All lengths are in
    metres.
    """
    i = code >> 3
    shape = world.shapes[i]
    air = world.air[0]
    row, normal, u, v = surface(shape, world.heights, code & 7, place)
    texture = world.textures[row]
    # bent and cut shapes shade themselves
    own = -1 if hollow(shape) else i
    # a pixel covers more of a slanted surface, with a limit at its outline
    slant = footprint / math.sqrt(max(-dot(normal, view), 0.06))
    albedo = color(texture, u, v, slant / shape.scale)
    open_ = visible(world.shapes, around, i, place, normal, air.occlusion, air.reach, footprint)
    ambient = mix(air.below, air.above, 0.5 + 0.5 * normal[2])
    seen = product(times(open_, albedo), ambient)
    gloss = texture.specular
    shine = texture.shine if gloss > 0 else 0.0
    for k in range(world.lights.shape[0]):
        light = world.lights[k]
        even, high = _light(light, world.shadows, own, place, normal, view, open_, shine)
        high *= gloss
        reflected = along((high, high, high), even, albedo)
        seen = along(seen, 1.0, product(reflected, light.color))
    # like an exponential near the camera, and cheaper
    mist = 1.0 - 1.0 / (1.0 + air.fog * distance)
    return mix(seen, air.horizon, mist)


@inner
def _gather(t, code, i, j, own, samples):
    """Average the rays of a pixel that hit the same face, and mark them as TAKEN in `code`.

    own: code of the face. Returns the number of these rays, their mean t, and the means of their
    columns and of their rows within the pixel, both weighted by t.
    """
    n = 0
    t_sum = u_sum = v_sum = ZERO
    for a in range(samples):
        for b in range(samples):
            if code[i + a, j + b] == own:
                code[i + a, j + b] = TAKEN
                n += 1
                # the sky has no distance, so its rays have equal weights
                distance = t[i + a, j + b] if own != SKY else ONE
                t_sum += distance
                u_sum += distance * b
                v_sum += distance * a
    # with these weights the point at the mean t is the mean of the hits
    return n, t_sum / n, u_sum / t_sum, v_sum / t_sum


@kernel
def paint(image, t, code, top, samples, world, c2w, rays):
    """Colour a band of image rows, `image` (rows, W, 3) float32 linear light. Overwrites `code`.

    t, code, rays: depths, face codes and ray basis of the band from `trace`. top: number of the
    band's first row in the image. Rays of a pixel that hit one face are shaded once, at their mean.
    """
    # kept over the band, because neighbouring points have the same boxes nearby
    around = surroundings(world.shapes)
    step = 1.0 / samples
    eye = triple(c2w[:, 3])
    spread = math.sqrt(dot(rays[1], rays[1]))
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
                    n, depth, u, v = _gather(t, code, i, j, own, samples)
                    u = column + (u + 0.5) * step
                    v = top + row + (v + 0.5) * step
                    d = along(along(rays[0], u, rays[1]), v, rays[2])
                    long = math.sqrt(dot(d, d))
                    view = over(d, long)
                    if own == SKY:
                        seen = _sky(world.air[0], world.lights, view)
                    else:
                        place = along(eye, depth, d)
                        size = spread * depth
                        seen = _shade(world, around, int(own), place, view, size, depth * long)
                    total = along(total, n, seen)
            image[row, column] = times(step * step, total)

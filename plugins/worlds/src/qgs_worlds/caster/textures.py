"""Colours of textures at a point of a surface: noise, with patterns on top."""

import math

import numpy as np

from qgs_worlds.caster import tables as s
from qgs_worlds.caster.vectors import inner, mix, times

# Side of the table of random numbers, which noise repeats; a power of two, for `chance`.
_SIDE = 64
# Mean of glyphs: words, letters, part of a cell and dots in it.
_INK = 0.24
_TABLE = np.random.default_rng(7).random((_SIDE, _SIDE)).astype(np.float32)


@inner
def chance(i, j, seed):
    """Return a pseudo-random number in [0, 1) for the point (i, j) of an integer grid."""
    return float(_TABLE[(i + seed) & (_SIDE - 1), (j + (seed >> 6)) & (_SIDE - 1)])


@inner
def _corner(basis, i, j, seed, x, y):
    """Return the contribution of grid point (i, j) to noise at the offset (x, y) from it.

    VALUE noise contributes a random number, GRADIENT noise a random slope times the offset.
    """
    if basis == s.VALUE:
        return chance(i, j, seed) - 0.5
    return (2 * chance(i, j, seed) - 1.0) * x + (2 * chance(j, i, seed + 1371) - 1.0) * y


@inner
def _cells(x, y, i, j, seed):
    """Return noise at (x, y) from random points, one in each cell of a grid.

    The noise is the distance to the nearest of these points, with a mean of about 0 after a shift.
    i, j: cell of (x, y).
    """
    least = 4.0
    for a in range(-1, 2):
        for b in range(-1, 2):
            u = i + a + chance(i + a, j + b, seed) - x
            v = j + b + chance(j + b, i + a, seed + 1371) - y
            least = min(least, u * u + v * v)
    return 1.4 * (math.sqrt(least) - 0.45)


@inner
def eased(x):
    """Return smoothstep at x in [0, 1]: a step from 0 to 1 whose slope is 0 at both ends."""
    return x * x * (3 - 2 * x)


@inner
def noise(basis, x, y, seed):
    """Return noise at (x, y) with a mean of about 0, mostly between -0.5 and 0.5.

    basis: kind of noise: VALUE, GRADIENT or CELLS. Its grid has cells of size 1.
    """
    i = math.floor(x)
    j = math.floor(y)
    if basis == s.CELLS:
        return _cells(x, y, i, j, seed)
    a = x - i
    b = y - j
    c00 = _corner(basis, i, j, seed, a, b)
    c10 = _corner(basis, i + 1, j, seed, a - 1, b)
    c01 = _corner(basis, i, j + 1, seed, a, b - 1)
    c11 = _corner(basis, i + 1, j + 1, seed, a - 1, b - 1)
    across = eased(a)
    low = c00 + across * (c10 - c00)
    high = c01 + across * (c11 - c01)
    return low + eased(b) * (high - low)


@inner
def _seen(footprint, period):
    """Return the visibility of details of a texture, from 0 to 1.

    period: size of a repeated detail. footprint: distance between neighbouring pixels in the same
    unit; details of two footprints or less have visibility 0.
    """
    return min(max(2.0 - 4.0 * footprint / period, 0.0), 1.0)


@inner
def _octaves(texture, x, y, footprint):
    """Return the sum of a texture's noise octaves at (x, y), around 0.5.

    x, y and footprint (distance between neighbouring pixels) are in periods of the texture.
    """
    total = 0.0
    weight = texture.contrast
    for octave in range(texture.octaves):
        seen = _seen(footprint, 1.0)
        if seen <= 0:
            break
        total += seen * weight * noise(texture.basis, x, y, texture.seed + 389 * octave)
        # octaves of nearly twice the frequency, so that their lattices do not coincide
        x = 1.97 * x + 7.3
        y = 1.97 * y
        footprint = 1.97 * footprint
        weight = weight * texture.gain
    return 0.5 + total


@inner
def _step(x, blur):
    """Return a step from 0 to 1 at x = 0, blurred over a width `blur`."""
    return min(max(0.5 + x / blur, 0.0), 1.0)


@inner
def _bar(x, width, blur):
    """Return 1 inside bars of width `width` around integers x, else 0; edges have width `blur`."""
    return _step(0.5 * width - abs(x - math.floor(x + 0.5)), blur)


@inner
def _glyphs(x, y, seed):
    """Return 1 if (x, y) is on the ink of a text of random letters, else 0.

    A line has height 1, a letter width 1. Letters consist of 4 x 6 dots.
    """
    line = math.floor(y)
    place = math.floor(x)
    if chance(place // 3, line, seed + 5) < 0.25 or chance(place, line, seed) < 0.15:
        return 0.0
    i = math.floor(5 * (x - place))
    j = math.floor(7 * (y - line))
    if i > 3 or j > 5 or chance(4 * place + i, 6 * line + j, seed + 1) < 0.45:
        return 0.0
    return 1.0


@inner
def _mean(kind, width):
    """Return the fraction of a surface in a pattern's colour. width: of stripes, dots, joints."""
    if kind == s.CHECKER:
        return 0.5
    if kind == s.TILES:
        return 1.0 - (1.0 - 0.25 * width) ** 2
    if kind == s.DOTS:
        return math.pi * (0.55 * width) ** 2
    return _INK if kind == s.GLYPHS else width


@inner
def _pattern(kind, x, y, width, seed, blur):
    """Return how much of the pattern's colour covers (x, y), and a random tone, both in [0, 1].

    The tone differs from stripe to stripe or from tile to tile. x, y, blur (width of the edges): in
    periods of the pattern.
    """
    if kind == s.STRIPES or kind == s.RINGS:
        place = x if kind == s.STRIPES else math.sqrt(x * x + y * y)
        return _bar(place, width, blur), chance(math.floor(place + 0.5), 0, seed)
    i = math.floor(x)
    j = math.floor(y)
    if kind == s.CHECKER:
        a = 2 * _bar(0.5 * x, 0.5, blur) - 1
        b = 2 * _bar(0.5 * y, 0.5, blur) - 1
        return 0.5 + 0.5 * a * b, chance(i, j, seed)
    if kind == s.TILES:
        # half of the textures shift every second row by half a tile
        x += 0.5 * (j & 1) * (seed & 1)
        joint = max(_bar(x, 0.25 * width, blur), _bar(y, 0.25 * width, blur))
        return joint, chance(math.floor(x), j, seed)
    if kind == s.DOTS:
        a = x - i - 0.5
        b = y - j - 0.5
        return _step(0.55 * width - math.sqrt(a * a + b * b), blur), chance(i, j, seed)
    return _INK + _seen(blur, 0.4) * (_glyphs(x, y, seed) - _INK), 0.5


@inner
def _marked(texture, rgb, u, v, warped, footprint):
    """Return the colour `rgb` with the pattern of a texture blended over it, at (u, v).

    warped: u / texture.period, plus the shift at (u, v) that warps noise and pattern.
    """
    period = texture.pattern_period
    blur = footprint / period * max(texture.aspect, 1.0)
    x = u / period * texture.aspect + 0.2 * (warped - u / texture.period)
    kind = texture.pattern
    w, tone = _pattern(kind, x, v / period, texture.width, texture.seed, blur + 1e-6)
    # far away, a pattern fades to its mean
    seen = _seen(blur, 1.6)
    mean = _mean(kind, texture.width)
    w = texture.strength * (mean + seen * (w - mean))
    shade = 1 + texture.tone * seen * (tone - 0.5)
    return mix(times(shade, rgb), texture.colors[3], w)


@inner
def color(texture, u, v, footprint):
    """Return the RGB of a texture at (u, v).

    footprint: distance between neighbouring pixels on the surface. u, v and footprint have the
    same unit.
    """
    x = u / texture.period
    y = v / texture.period
    if texture.warp > 0:
        shift = texture.warp * noise(s.VALUE, 0.7 * x, 0.7 * y, texture.seed + 31)
        x = x + shift
        y = y - shift
    spread = footprint / texture.period * max(texture.stretch, 1.0)
    f = min(max(_octaves(texture, texture.stretch * x, y, spread), 0.0), 1.0)
    first = 0 if f < 0.5 else 1
    rgb = mix(texture.colors[first], texture.colors[first + 1], 2 * f - first)
    if texture.pattern != s.NO_PATTERN:
        rgb = _marked(texture, rgb, u, v, x, footprint)
    return rgb

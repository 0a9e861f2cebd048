"""Noise and patterns of textures, looked up at a point of a surface."""

import math

import numpy as np
from numba import njit

from qgs_worlds import rows as r
from qgs_worlds.kernels import BORROWING

_SIDE = 64  # of the table of random numbers, which noise repeats
_INK = 0.24  # mean of glyphs: words, letters, part of a cell and dots in it
_TABLE = np.random.default_rng(7).random((_SIDE, _SIDE)).astype(np.float32)


@njit(**BORROWING)
def chance(i, j, seed):
    """A number in [0, 1) for each lattice point."""
    return float(_TABLE[(i + seed) & (_SIDE - 1), (j + (seed >> 6)) & (_SIDE - 1)])


@njit(**BORROWING)
def _slope(i, j, seed, x, y):
    """Height at (x, y) of a plane through the lattice point with a random slope."""
    return (2 * chance(i, j, seed) - 1.0) * x + (2 * chance(j, i, seed + 1371) - 1.0) * y


@njit(**BORROWING)
def _corner(basis, i, j, seed, x, y):
    return chance(i, j, seed) - 0.5 if basis == r.VALUE else _slope(i, j, seed, x, y)


@njit(**BORROWING)
def _cells(x, y, i, j, seed):
    """Distance to the nearest of points scattered one to a cell, less its mean."""
    least = 4.0
    for a in range(-1, 2):
        for b in range(-1, 2):
            u = i + a + chance(i + a, j + b, seed) - x
            v = j + b + chance(j + b, i + a, seed + 1371) - y
            least = min(least, u * u + v * v)
    return 1.4 * (math.sqrt(least) - 0.45)


@njit(**BORROWING)
def noise(basis, x, y, seed):
    """Noise of unit period and a mean of about 0, mostly within -0.5 and 0.5."""
    i, j = math.floor(x), math.floor(y)
    if basis == r.CELLS:
        return _cells(x, y, i, j, seed)
    a, b = x - i, y - j
    c00, c10 = _corner(basis, i, j, seed, a, b), _corner(basis, i + 1, j, seed, a - 1, b)
    c01, c11 = (
        _corner(basis, i, j + 1, seed, a, b - 1),
        _corner(basis, i + 1, j + 1, seed, a - 1, b - 1),
    )
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    low, high = c00 + a * (c10 - c00), c01 + a * (c11 - c01)
    return low + b * (high - low)


@njit(**BORROWING)
def _seen(footprint, period):
    """How much is seen of what has a period: 0 where it is finer than two footprints."""
    return min(max(2.0 - 4.0 * footprint / period, 0.0), 1.0)


@njit(**BORROWING)
def _octaves(textures, row, x, y, footprint):
    """Noise in octaves, about 0.5; x, y: in periods, as is the footprint."""
    basis, seed = int(textures[row, r.BASIS]), int(textures[row, r.SEED])
    total, weight = 0.0, textures[row, r.CONTRAST]
    for octave in range(int(textures[row, r.OCTAVES])):
        seen = _seen(footprint, 1.0)
        if seen <= 0:
            break
        total += seen * weight * noise(basis, x, y, seed + 389 * octave)
        x, y, footprint, weight = (
            1.97 * x + 7.3,
            1.97 * y,
            1.97 * footprint,
            weight * textures[row, r.GAIN],
        )
    return 0.5 + total


@njit(**BORROWING)
def _step(x, blur):
    """A step at 0, blurred."""
    return min(max(0.5 + x / blur, 0.0), 1.0)


@njit(**BORROWING)
def _bar(x, width, blur):
    """1 within `width` around an integer, 0 elsewhere."""
    return _step(0.5 * width - abs(x - math.floor(x + 0.5)), blur)


@njit(**BORROWING)
def _glyphs(x, y, seed):
    """Lines of marks: random dots of 4 x 6 in a cell, words apart, lines of several lengths."""
    line, place = math.floor(y), math.floor(x)
    if chance(place // 3, line, seed + 5) < 0.25 or chance(place, line, seed) < 0.15:
        return 0.0
    a, b = 5 * (x - place), 7 * (y - line)
    i, j = math.floor(a), math.floor(b)
    if i > 3 or j > 5 or chance(4 * place + i, 6 * line + j, seed + 1) < 0.45:
        return 0.0
    return 1.0


@njit(**BORROWING)
def _mean(kind, width):
    """How much of the fourth colour a pattern has."""
    if kind == r.CHECKER:
        return 0.5
    if kind == r.TILES:
        return 1.0 - (1.0 - 0.25 * width) ** 2
    if kind == r.DOTS:
        return math.pi * (0.55 * width) ** 2
    return _INK if kind == r.GLYPHS else width


@njit(**BORROWING)
def _pattern(kind, x, y, width, seed, blur):
    """How much of the fourth colour is seen, and the tone of the cell in [0, 1]."""
    i, j = math.floor(x), math.floor(y)
    if kind == r.STRIPES:
        return _bar(x, width, blur), chance(math.floor(x + 0.5), 0, seed)
    if kind == r.RINGS:
        x = math.sqrt(x * x + y * y)
        return _bar(x, width, blur), chance(math.floor(x + 0.5), 0, seed)
    if kind == r.CHECKER:
        a, b = 2 * _bar(0.5 * x, 0.5, blur) - 1, 2 * _bar(0.5 * y, 0.5, blur) - 1
        return 0.5 + 0.5 * a * b, chance(i, j, seed)
    if kind == r.TILES:
        x += 0.5 * (j & 1) * (seed & 1)
        joint = max(_bar(x, 0.25 * width, blur), _bar(y, 0.25 * width, blur))
        return joint, chance(math.floor(x), j, seed)
    if kind == r.DOTS:
        a, b = x - i - 0.5, y - j - 0.5
        return _step(0.55 * width - math.sqrt(a * a + b * b), blur), chance(i, j, seed)
    return _INK + _seen(blur, 0.4) * (_glyphs(x, y, seed) - _INK), 0.5


@njit(**BORROWING)
def color(textures, row, u, v, footprint):
    """RGB of a texture at u, v; footprint: distance of neighbouring pixels there, same unit."""
    seed, period = int(textures[row, r.SEED]), textures[row, r.PERIOD]
    x, y = u / period, v / period
    if textures[row, r.WARP] > 0:
        shift = noise(r.VALUE, 0.7 * x, 0.7 * y, seed + 31)
        x, y = x + textures[row, r.WARP] * shift, y - textures[row, r.WARP] * shift
    spread = footprint / period * max(textures[row, r.STRETCH], 1.0)
    f = min(max(_octaves(textures, row, textures[row, r.STRETCH] * x, y, spread), 0.0), 1.0)
    first, f = (r.COLORS, 2 * f) if f < 0.5 else (r.COLORS + 3, 2 * f - 1)
    red = textures[row, first] + f * (textures[row, first + 3] - textures[row, first])
    green = textures[row, first + 1] + f * (textures[row, first + 4] - textures[row, first + 1])
    blue = textures[row, first + 2] + f * (textures[row, first + 5] - textures[row, first + 2])
    kind = int(textures[row, r.PATTERN])
    if kind != r.NO_PATTERN:
        period = textures[row, r.PATTERN_PERIOD]
        aspect = textures[row, r.ASPECT]
        blur = footprint / period * max(aspect, 1.0)
        x, y = u / period * aspect + 0.2 * (x - u / textures[row, r.PERIOD]), v / period
        w, tone = _pattern(kind, x, y, textures[row, r.WIDTH], seed, blur + 1e-6)
        seen = _seen(blur, 1.6)
        mean = _mean(kind, textures[row, r.WIDTH])
        w = textures[row, r.STRENGTH] * (mean + seen * (w - mean))
        shade = 1 + textures[row, r.TONE] * seen * (tone - 0.5)
        last = r.COLORS + 9
        red = shade * red + w * (textures[row, last] - shade * red)
        green = shade * green + w * (textures[row, last + 1] - shade * green)
        blue = shade * blue + w * (textures[row, last + 2] - shade * blue)
    return red, green, blue

"""Texture patterns of furnished rooms, evaluated at a point of a surface."""

import math

from qgs_worlds.caster.textures import eased
from qgs_worlds.caster.vectors import inner

(PLAIN, CHECKER, STRIPES, PLANKS, TILES, BRICKS, CLOUDS, GRADIENT, PICTURE, RUG, WINDOW, DOTS,
 BOOKS) = range(13)  # fmt: skip


@inner
def _hash(i, j, seed):
    """Return a pseudo-random number in [0, 1) for the point (i, j) of an integer grid."""
    # primes of xxHash, which spread neighbours over all bits
    h = (i * 374761393 + j * 668265263 + seed * 974634777) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return (h ^ (h >> 16)) / 4294967296.0


@inner
def _noise(x, y, seed):
    """Return value noise in [0, 1] at (x, y), from random values at integer coordinates."""
    i = math.floor(x)
    j = math.floor(y)
    a = eased(x - i)
    b = eased(y - j)
    low = _hash(i, j, seed) * (1 - a) + _hash(i + 1, j, seed) * a
    high = _hash(i, j + 1, seed) * (1 - a) + _hash(i + 1, j + 1, seed) * a
    return low * (1 - b) + high * b


@inner
def _part(x):
    """Return the fractional part of x."""
    return x - math.floor(x)


@inner
def _seam(x, width):
    """Return 1 if x is within `width` of an integer, else 0."""
    f = _part(x)
    return 1.0 if f < width or f > 1 - width else 0.0


@inner
def _grid(x, y, shift, seed, softness):
    """Return tone and joint of tiles at (x, y), both from 0 to 1. Tiles have size 1.

    tone: random brightness, which differs from tile to tile. joint: 0 on a tile, `softness` in the
    gap between two tiles. shift: offset of every second row.
    """
    row = math.floor(y)
    x = x + shift * (row & 1)
    # no two tiles are quite alike
    tone = 0.6 * _hash(math.floor(x), row, seed) + 0.4 * _noise(3 * x, 3 * y, seed)
    # a brick is twice as long as high, so a joint takes twice the share of its height
    return tone, softness * max(_seam(x, 0.03), _seam(y, 0.03 * (1 + 2 * shift)))


@inner
def _planks(x, y, seed, fade):
    board = math.floor(x)
    # boards start at different heights
    along = y * 0.16 + 7.0 * _hash(board, 3, seed)
    tone = 0.6 * _hash(board, math.floor(along), seed)
    # grain that fades leaves its mean, 0.2
    tone += 0.4 * _noise(x * 9, y * 0.7, seed) * fade + 0.2 * (1 - fade)
    return tone, fade * max(_seam(x, 0.03), _seam(along, 0.005))


@inner
def _picture(p, q, seed):
    """Return the weights (m, n) that mix three colours to a painted landscape at (p, q).

    The picture shows hills under a sky with a sun. p, q: in [-1, 1]. The RGB is
    lerp(lerp(a, b, m), c, n) for colours a, b and c.
    """
    hill = 0.35 * (_noise(1.5 * p + 9, 0.5, seed) + 0.5 * _noise(4 * p, 2.5, seed)) - 0.45
    # hills farther off are higher and paler
    far = hill + 0.35 * _noise(1.2 * p + 40, 8.5, seed) + 0.1
    if q < hill:
        return 0.2, 1.0
    if q < far:
        return 0.5, 0.6
    sun_p = 0.9 * _hash(1, 1, seed) - 0.45
    sun_q = 0.35 + 0.3 * _hash(2, 2, seed)
    if (p - sun_p) ** 2 + (q - sun_q) ** 2 < 0.04:
        return 1.0, 0.0
    return 0.25 - 0.25 * q, 0.0


@inner
def _rug(p, q, x, y, seed):
    """Return the weights (m, n) that mix three colours to a rug at (p, q) in [-1, 1].

    The rug has two borders, a centre ring and diamonds with period 1 in x, y. The RGB is
    lerp(lerp(a, b, m), c, n) for colours a, b and c.
    """
    edge = min(1 - abs(p), 1 - abs(q))
    ring = abs(p) + abs(q)
    if edge < 0.06 or 0.14 < edge < 0.18:
        return 1.0, 0.0
    if edge < 0.14:
        return 0.0, 0.8
    if ring < 0.25:
        return 1.0, 0.0
    if ring < 0.45:
        return 0.0, 1.0
    diamond = abs(_part(x) - 0.5) + abs(_part(y) - 0.5)
    return (0.7 if diamond < 0.28 else 0.0) + 0.15 * _noise(6 * x, 6 * y, seed), 0.0


@inner
def _window(p, q, seed):
    """Return the weights (m, n) that mix three colours to a window at (p, q) in [-1, 1].

    The window has a frame and glazing bars, and shows trees and sky. The RGB is
    lerp(lerp(a, b, m), c, n) for colours a, b and c.
    """
    if abs(p) < 0.03 or abs(q - 0.25) < 0.025 or abs(p) > 0.94 or abs(q) > 0.95:
        return 0.0, 1.0
    trees = -0.5 + 0.5 * _noise(3 * p, 0.5, seed) + 0.15 * _noise(11 * p, 3.5, seed)
    if q < trees:
        return 1.0, 0.25
    return 0.3 * _noise(2 * p, 3 * q, seed), 0.0


@inner
def _spines(x, seed):
    """Return the weights (m, n) that mix three colours to a row of book spines.

    Some spines have a band. x: position in the row, in widths of a book. The RGB is
    lerp(lerp(a, b, m), c, n) for colours a, b and c.
    """
    i = math.floor(x + 0.3 * _noise(x, 0.5, seed))
    return _hash(i, 1, seed), (0.9 * _hash(i, 2, seed) if _hash(i, 3, seed) > 0.5 else 0.0)


@inner
def smooth(kind):
    """Return True if the pattern `kind` has no sharp edges, else False."""
    return kind in (PLAIN, CLOUDS, GRADIENT)


@inner
def mixture(texture, u, v, p, q, footprint):
    """Return weights (m, n) by which a texture mixes its three colours a, b, c at a point.

    The RGB of the texture is lerp(lerp(a, b, m), c, n). u, v: position on the surface in metres.
    p, q: position in [-1, 1] across the surface. footprint: distance between neighbouring samples
    in metres; finer details fade away.
    """
    kind = texture.pattern
    seed = texture.seed
    x = u / texture.period
    y = v / texture.period
    # all details from five samples in a period on, none below about two
    fade = min(max(1.6 - 3 * footprint / texture.period, 0.0), 1.0)
    if kind == CHECKER:
        odd = (math.floor(x) + math.floor(y)) & 1
        return 0.5 + fade * (odd - 0.5), 0.0
    if kind == STRIPES:
        f = _part(x)
        return 0.5 + fade * ((1.0 if f < 0.45 else 0.0) - 0.5), fade * (0.7 if f > 0.9 else 0.0)
    if kind == PLANKS:
        return _planks(x, y, seed, fade)
    if kind == TILES:
        return _grid(x, y, 0.0, seed, fade)
    if kind == BRICKS:
        return _grid(0.5 * x, y, 0.5, seed, fade)
    if kind == CLOUDS:
        return 0.65 * _noise(x, y, seed) + 0.35 * _noise(2.7 * x, 2.7 * y, seed + 1), 0.0
    if kind == GRADIENT:
        return 0.5 + 0.5 * q, 0.0
    if kind == PICTURE:
        return _picture(p, q, seed)
    if kind == RUG:
        return _rug(p, q, x, y, seed)
    if kind == WINDOW:
        return _window(p, q, seed)
    if kind == DOTS:
        a = _part(x) - 0.5
        b = _part(y) - 0.5
        return 0.0, (fade if a * a + b * b < 0.08 else 0.2 * (1 - fade))
    if kind == BOOKS:
        return _spines(x, seed)
    return 0.5 * _noise(3 * u, 3 * v, seed) + 0.25, 0.0

"""Patterns of textures, looked up at a point of a surface; and how kernels are compiled."""

import math

from numba import njit

from qgs_worlds.rooms import shapes as s

OPTIONS = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "arcp", "nsz"},
    # Cached kernels share the functions that they call by name, so that one loaded from the cache
    # may run another kernel's build of them, with other roundings; what is inlined is its own.
    "forceinline": True,
}
INNER = {**OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}  # called by kernels alone


@njit(**INNER)
def _hash(i, j, seed):
    """A number in [0, 1) for each lattice point."""
    h = (i * 374761393 + j * 668265263 + seed * 974634777) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return (h ^ (h >> 16)) / 4294967296.0


@njit(**INNER)
def _noise(x, y, seed):
    """Value noise in [0, 1] with unit period."""
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    low = _hash(i, j, seed) * (1 - a) + _hash(i + 1, j, seed) * a
    high = _hash(i, j + 1, seed) * (1 - a) + _hash(i + 1, j + 1, seed) * a
    return low * (1 - b) + high * b


@njit(**INNER)
def _seam(x, width):
    """1 within `width` of an integer, 0 elsewhere."""
    f = x - math.floor(x)
    return 1.0 if f < width or f > 1 - width else 0.0


@njit(**INNER)
def _grid(x, y, shift, seed, softness):
    """Tiles of unit size: a tone for each, and the joints between them."""
    row = math.floor(y)
    x = x + shift * (row & 1)
    tone = 0.6 * _hash(math.floor(x), row, seed) + 0.4 * _noise(3 * x, 3 * y, seed)
    return tone, softness * max(_seam(x, 0.03), _seam(y, 0.03 * (1 + 2 * shift)))


@njit(**INNER)
def _planks(x, y, seed, fade):
    board = math.floor(x)
    along = y * 0.16 + 7.0 * _hash(board, 3, seed)
    tone = 0.6 * _hash(board, math.floor(along), seed)
    tone += 0.4 * _noise(x * 9, y * 0.7, seed) * fade + 0.2 * (1 - fade)
    return tone, fade * max(_seam(x, 0.03), _seam(along, 0.005))


@njit(**INNER)
def _picture(p, q, seed):
    """A landscape: hills under a sky with a sun."""
    hill = 0.35 * (_noise(1.5 * p + 9, 0.5, seed) + 0.5 * _noise(4 * p, 2.5, seed)) - 0.45
    far = hill + 0.35 * _noise(1.2 * p + 40, 8.5, seed) + 0.1
    sun_p, sun_q = 0.9 * _hash(1, 1, seed) - 0.45, 0.35 + 0.3 * _hash(2, 2, seed)
    if q < hill:
        return 0.2, 1.0
    if q < far:
        return 0.5, 0.6
    if (p - sun_p) ** 2 + (q - sun_q) ** 2 < 0.04:
        return 1.0, 0.0
    return 0.25 - 0.25 * q, 0.0


@njit(**INNER)
def _rug(p, q, u, v, period, seed):
    edge = min(1 - abs(p), 1 - abs(q))
    if edge < 0.06 or 0.14 < edge < 0.18:
        return 1.0, 0.0
    if edge < 0.14:
        return 0.0, 0.8
    ring = abs(p) + abs(q)
    if ring < 0.25:
        return 1.0, 0.0
    if ring < 0.45:
        return 0.0, 1.0
    x, y = u / period, v / period
    diamond = abs(x - math.floor(x) - 0.5) + abs(y - math.floor(y) - 0.5)
    return (0.7 if diamond < 0.28 else 0.0) + 0.15 * _noise(6 * x, 6 * y, seed), 0.0


@njit(**INNER)
def _window(p, q, seed):
    if abs(p) < 0.03 or abs(q - 0.25) < 0.025 or abs(p) > 0.94 or abs(q) > 0.95:
        return 0.0, 1.0
    trees = -0.5 + 0.5 * _noise(3 * p, 0.5, seed) + 0.15 * _noise(11 * p, 3.5, seed)
    if q < trees:
        return 1.0, 0.25
    return 0.3 * _noise(2 * p, 3 * q, seed), 0.0


@njit(**INNER)
def smooth(kind):
    """Whether a texture has no edges inside."""
    return kind in (s.PLAIN, s.CLOUDS, s.GRADIENT)


@njit(**INNER)
def mixture(kind, period, seed, u, v, p, q, footprint):
    """Weights (m, n): the colour is lerp(lerp(a, b, m), c, n).

    u, v: position on the surface in metres. p, q: the same in [-1, 1] across the surface.
    footprint: distance between neighbouring samples in metres; what is finer than it fades away.
    """
    x, y = u / period, v / period
    fade = min(max(1.6 - 3 * footprint / period, 0.0), 1.0)
    if kind == s.CHECKER:
        odd = (math.floor(x) + math.floor(y)) & 1
        return 0.5 + fade * (odd - 0.5), 0.0
    if kind == s.STRIPES:
        f = x - math.floor(x)
        return 0.5 + fade * ((1.0 if f < 0.45 else 0.0) - 0.5), fade * (0.7 if f > 0.9 else 0.0)
    if kind == s.PLANKS:
        return _planks(x, y, seed, fade)
    if kind == s.TILES:
        return _grid(x, y, 0.0, seed, fade)
    if kind == s.BRICKS:
        return _grid(0.5 * x, y, 0.5, seed, fade)
    if kind == s.CLOUDS:
        return 0.65 * _noise(x, y, seed) + 0.35 * _noise(2.7 * x, 2.7 * y, seed + 1), 0.0
    if kind == s.GRADIENT:
        return 0.5 + 0.5 * q, 0.0
    if kind == s.PICTURE:
        return _picture(p, q, seed)
    if kind == s.RUG:
        return _rug(p, q, u, v, period, seed)
    if kind == s.WINDOW:
        return _window(p, q, seed)
    if kind == s.DOTS:
        a, b = x - math.floor(x) - 0.5, y - math.floor(y) - 0.5
        return 0.0, (fade if a * a + b * b < 0.08 else 0.2 * (1 - fade))
    if kind == s.BOOKS:
        i = math.floor(x + 0.3 * _noise(x, 0.5, seed))
        return _hash(i, 1, seed), (0.9 * _hash(i, 2, seed) if _hash(i, 3, seed) > 0.5 else 0.0)
    return 0.5 * _noise(3 * u, 3 * v, seed) + 0.25, 0.0

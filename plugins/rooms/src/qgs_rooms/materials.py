"""Materials of a room's surfaces, and their textures."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence

from numba import njit

from qgs_rooms import shapes as s
from qgs_rooms.draws import Draws
from qgs_rooms.shapes import Color

WHITE: Color = (0.95, 0.94, 0.91)
DARK: Color = (0.10, 0.09, 0.09)
WOODS: tuple[Color, ...] = (
    (0.72, 0.52, 0.32),
    (0.55, 0.35, 0.20),
    (0.36, 0.22, 0.14),
    (0.82, 0.68, 0.48),
    (0.62, 0.58, 0.53),
)
_ACCENT = (s.PLAIN, s.STRIPES, s.CHECKER, s.DOTS, s.CLOUDS, s.GRADIENT)


def toned(color: Color, factor: float) -> Color:
    """`color` made darker (factor < 1) or lighter, within [0, 1]."""
    r, g, b = color
    return min(r * factor, 1.0), min(g * factor, 1.0), min(b * factor, 1.0)


class Materials:
    """The growing list of a room's textures, drawn from a few hues that go together."""

    def __init__(self, rng: Draws) -> None:
        self.rng = rng
        self.rows: list[tuple[float, ...]] = []
        base = rng.random()
        self._hues = [(base + step + 0.04 * rng.gauss(0, 1)) % 1 for step in (0.0, 0.08, 0.5, 0.35)]
        self.wood = WOODS[rng.integers(len(WOODS))]

    def add(self, kind: int, period: float, colors: Sequence[Color], emission: float = 0.0) -> int:
        """Register a texture of three colours and return its index."""
        a, b, c = colors
        seed = float(int(self.rng.random() * 65536))
        self.rows.append((kind, period, seed, emission, *a, *b, *c))
        return len(self.rows) - 1

    def color(self, saturation: tuple[float, float], value: tuple[float, float]) -> Color:
        """One of the room's hues at a random saturation and value."""
        pick, s, v = (self.rng.random() for _ in range(3))
        hue = self._hues[int(pick * len(self._hues))]
        return colorsys.hsv_to_rgb(
            hue,
            saturation[0] + s * (saturation[1] - saturation[0]),
            value[0] + v * (value[1] - value[0]),
        )

    def paint(self) -> int:
        """A nearly even colour for lacquered things."""
        color = self.color((0.3, 0.85), (0.35, 0.95))
        return self.add(s.PLAIN, 1.0, (toned(color, 0.93), toned(color, 1.07), DARK))

    def pale(self) -> int:
        """A pale, even colour: ceilings, lamp shades, doors."""
        color = self.color((0.0, 0.12), (0.85, 0.98))
        return self.add(s.PLAIN, 1.0, (toned(color, 0.98), color, DARK))

    def metal(self) -> int:
        """Dark or light grey."""
        grey = self.rng.choice([0.2, 0.45, 0.75])
        return self.add(s.PLAIN, 1.0, ((grey, grey, grey), (grey, grey, grey), DARK))

    def timber(self) -> int:
        """Wood of the room's kind, with grain."""
        wood = toned(self.wood, self.rng.uniform(0.8, 1.15))
        period = self.rng.uniform(0.12, 0.3)
        return self.add(s.PLANKS, period, (toned(wood, 0.75), toned(wood, 1.15), toned(wood, 0.5)))

    def fabric(self) -> int:
        """A patterned cloth or ornament."""
        kind = self.rng.choice(_ACCENT)
        a, b = self.color((0.25, 0.8), (0.3, 0.9)), self.color((0.1, 0.7), (0.5, 0.98))
        return self.add(kind, self.rng.uniform(0.1, 0.3), (a, b, WHITE))

    def books(self) -> int:
        """A row of spines."""
        a, b = self.color((0.4, 0.9), (0.2, 0.5)), self.color((0.2, 0.8), (0.6, 0.95))
        return self.add(s.BOOKS, self.rng.uniform(0.03, 0.06), (a, b, WHITE))

    def picture(self) -> int:
        """A landscape for a frame."""
        sky, land = self.color((0.2, 0.6), (0.7, 0.95)), self.color((0.4, 0.9), (0.2, 0.5))
        return self.add(s.PICTURE, 1.0, (sky, (0.98, 0.92, 0.7), land), 0.1)

    def rug(self) -> int:
        """A woven rug with borders."""
        a, b = self.color((0.4, 0.85), (0.3, 0.7)), self.color((0.1, 0.4), (0.75, 0.95))
        return self.add(s.RUG, self.rng.uniform(0.15, 0.3), (a, b, toned(a, 0.5)))

    def window(self) -> int:
        """Sky and trees behind panes; it shines."""
        green = (0.35, 0.5, 0.3) if self.rng.random() < 0.7 else (0.6, 0.55, 0.5)
        return self.add(s.WINDOW, 1.0, ((0.72, 0.85, 0.98), green, WHITE), 0.9)

    def glow(self) -> int:
        """A lamp shade lit from inside."""
        warm = (1.0, 0.93, 0.75)
        return self.add(s.PLAIN, 1.0, (warm, WHITE, WHITE), 0.85)

    def wall(self) -> int:
        """Paint, wallpaper or brick."""
        rng = self.rng
        color = self.color((0.04, 0.5), (0.5, 1.0))
        pick = rng.random()
        if pick < 0.12:
            brick = (rng.uniform(0.5, 0.7), 0.35, 0.27)
            colors = (toned(brick, 0.8), toned(brick, 1.15), (0.75, 0.72, 0.68))
            return self.add(s.BRICKS, 0.12, colors)
        if pick < 0.38:
            kind = rng.choice([s.STRIPES, s.DOTS, s.CHECKER])
            other = toned(color, rng.choice([0.78, 0.85, 1.12]))
            return self.add(kind, rng.uniform(0.2, 0.5), (color, other, WHITE))
        return self.add(s.CLOUDS, 1.2, (toned(color, 0.92), toned(color, 1.05), color))

    def floor(self) -> int:
        """Boards, tiles or carpet."""
        rng = self.rng
        pick = rng.random()
        if pick < 0.5:
            wood = WOODS[rng.integers(len(WOODS))]
            colors = (toned(wood, 0.75), toned(wood, 1.1), toned(wood, 0.45))
            return self.add(s.PLANKS, rng.uniform(0.12, 0.3), colors)
        if pick < 0.85:
            kind = rng.choice([s.TILES, s.CHECKER])
            color = self.color((0.05, 0.4), (0.5, 0.9))
            colors = (toned(color, 0.7), toned(color, 1.1), toned(color, 0.5))
            return self.add(kind, rng.uniform(0.3, 0.6), colors)
        color = self.color((0.2, 0.6), (0.35, 0.7))
        return self.add(s.CLOUDS, 0.25, (toned(color, 0.85), toned(color, 1.1), color))


OPTIONS = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "arcp", "nsz"},
}
INNER = {**OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}  # called by kernels alone

PLAIN, CHECKER, STRIPES, PLANKS, TILES = s.PLAIN, s.CHECKER, s.STRIPES, s.PLANKS, s.TILES
BRICKS, CLOUDS, GRADIENT, PICTURE = s.BRICKS, s.CLOUDS, s.GRADIENT, s.PICTURE
RUG, WINDOW, DOTS, BOOKS = s.RUG, s.WINDOW, s.DOTS, s.BOOKS


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
    return kind in (PLAIN, CLOUDS, GRADIENT)


@njit(**INNER)
def mixture(kind, period, seed, u, v, p, q, footprint):
    """Weights (m, n): the colour is lerp(lerp(a, b, m), c, n).

    u, v: position on the surface in metres. p, q: the same in [-1, 1] across the surface.
    footprint: distance between neighbouring samples in metres; what is finer than it fades away.
    """
    x, y = u / period, v / period
    fade = min(max(1.6 - 3 * footprint / period, 0.0), 1.0)
    if kind == CHECKER:
        odd = (math.floor(x) + math.floor(y)) & 1
        return 0.5 + fade * (odd - 0.5), 0.0
    if kind == STRIPES:
        f = x - math.floor(x)
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
        return _rug(p, q, u, v, period, seed)
    if kind == WINDOW:
        return _window(p, q, seed)
    if kind == DOTS:
        a, b = x - math.floor(x) - 0.5, y - math.floor(y) - 0.5
        return 0.0, (fade if a * a + b * b < 0.08 else 0.2 * (1 - fade))
    if kind == BOOKS:
        i = math.floor(x + 0.3 * _noise(x, 0.5, seed))
        return _hash(i, 1, seed), (0.9 * _hash(i, 2, seed) if _hash(i, 3, seed) > 0.5 else 0.0)
    return 0.5 * _noise(3 * u, 3 * v, seed) + 0.25, 0.0

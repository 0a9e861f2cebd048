"""Textures of a world: noise through ramps of colours that go together, and patterns over it."""

import colorsys
import math
from random import Random

import numpy as np
from numba import njit

from qgs_worlds import rows as r
from qgs_worlds.rooms.textures import OPTIONS
from qgs_worlds.textures import chance, noise
from qgs_worlds.things import spread

COUNT = 14  # textures of a world
_SIDE = 33  # points of a height map along each axis
_PLAIN_PATTERNS = (r.STRIPES, r.CHECKER, r.TILES, r.DOTS)
_PATTERNS = (*_PLAIN_PATTERNS, r.TILES, r.GLYPHS, r.GLYPHS, r.RINGS)

Color = tuple[float, float, float]


class Palette:
    """A few hues and a liking for colour or grey, for one world. Colours are linear."""

    def __init__(self, rng: Random) -> None:
        self.rng = rng
        base = rng.random()
        self._hues = [
            (base + step + 0.05 * rng.gauss(0, 1)) % 1 for step in (0, 0.06, 0.1, 0.5, 0.33)
        ]
        self._grey = rng.uniform(1.5, 7)

    def color(self) -> Color:
        """A colour: most are dull, few are bright or dark."""
        rng = self.rng
        hue = rng.choice(self._hues) if rng.random() < 0.8 else rng.random()
        saturation, value = rng.random() ** self._grey, rng.random()
        red, green, blue = colorsys.hsv_to_rgb(hue, saturation, 0.12 + 0.83 * value)
        return red**2.2, green**2.2, blue**2.2

    def near(self, color: Color, by: float) -> Color:
        """A colour that differs from another by about `by` stops, and a little in its hue."""
        tone = 2 ** self.rng.gauss(0, by)
        red, green, blue = (min(tone * c * 2 ** self.rng.gauss(0, 0.25 * by), 0.9) for c in color)
        return red, green, blue


def textures(rng: Random, varied: bool, highlights: bool) -> np.ndarray:
    """(COUNT, TEXTURE_FIELDS). Without highlights all else is drawn alike."""
    palette = Palette(rng)
    if not varied:
        return np.array([_plain(rng, palette) for _ in range(COUNT)])
    return np.array([_varied(rng, palette, highlights) for _ in range(COUNT)])


def _row(rng: Random, ramp: list[Color], mark: Color, **fields: float) -> list[float]:
    row = [0.0] * r.COLORS
    row[r.SEED], row[r.PERIOD], row[r.STRETCH] = rng.randrange(1 << 16), 1.0, 1.0
    row[r.PATTERN_PERIOD], row[r.ASPECT], row[r.GAIN] = 1.0, 1.0, 0.5
    for name, value in fields.items():
        row[getattr(r, name)] = value
    return row + [channel for color in (*ramp, mark) for channel in color]


def _plain(rng: Random, palette: Palette) -> list[float]:
    """An even surface, or two colours in a simple pattern."""
    base = palette.color()
    ramp = [palette.near(base, 0.1), base, palette.near(base, 0.1)]
    fields = {"OCTAVES": 1, "PERIOD": rng.uniform(0.3, 1), "CONTRAST": 0.6}
    if rng.random() < 0.5:
        return _row(rng, ramp, base, **fields)
    return _row(rng, ramp, palette.color(), **fields, **_pattern(rng, _PLAIN_PATTERNS))


def _pattern(rng: Random, kinds: tuple[int, ...]) -> dict[str, float]:
    kind = rng.choice(kinds)
    long = spread(rng, 0.25, 1) if kind == r.TILES else spread(rng, 0.6, 1.7)
    return {
        "PATTERN": kind,
        "PATTERN_PERIOD": spread(rng, 0.06, 0.5) * (0.7 if kind == r.GLYPHS else 1),
        "ASPECT": 1.6 if kind == r.GLYPHS else long,
        "WIDTH": rng.uniform(0.15, 0.7),
        "STRENGTH": rng.uniform(0.4, 1),
        "TONE": rng.choice((0.0, rng.uniform(0.2, 1.2))),
    }


def _varied(rng: Random, palette: Palette, highlights: bool) -> list[float]:
    """Noise with a spectrum near 1/f, half of it with a pattern; some surfaces are even."""
    base = palette.color()
    flat = rng.random() < 0.2
    by = 0.15 if flat else rng.uniform(0.5, 1.6)
    ramp = [palette.near(base, by), base, palette.near(base, by)]
    if not flat and rng.random() < 0.3:
        ramp[rng.randrange(3)] = palette.color()
    basis = rng.choice((r.VALUE, r.VALUE, r.GRADIENT, r.GRADIENT, r.CELLS))
    octaves, gain = (2 if basis == r.CELLS else rng.randint(3, 5)), rng.uniform(0.5, 0.85)
    norm = math.sqrt(sum(gain ** (2 * k) for k in range(octaves)))
    fields: dict[str, float] = {
        "BASIS": basis,
        "PERIOD": spread(rng, 0.15, 2),
        "OCTAVES": octaves,
        "GAIN": gain,
        "CONTRAST": rng.uniform(0.8, 2.2) / norm,
        "WARP": rng.choice((0.0, rng.uniform(0.3, 2))),
        "STRETCH": rng.choice((1.0, 1.0, spread(rng, 0.12, 8))),
    }
    if rng.random() < 0.4:
        fields |= _pattern(rng, _PATTERNS)
    shiny = rng.random() < 0.25
    gloss = {"SPECULAR": spread(rng, 0.05, 0.8), "SHINE": spread(rng, 5, 150)}
    if highlights and shiny:
        fields |= gloss
    return _row(rng, ramp, palette.color(), **fields)


@njit(**OPTIONS)
def height_maps(seed, count):
    """(count, 33, 33) float32 in [-1, 1]: smooth noise in octaves, each map of its own grain."""
    maps = np.empty((count, _SIDE, _SIDE), np.float32)
    for k in range(count):
        cells, gain = 2.0 + 5.0 * chance(k, 0, seed), 0.3 + 0.3 * chance(k, 1, seed)
        largest = 0.0
        for i in range(_SIDE):
            for j in range(_SIDE):
                x, y, weight, height = cells * i / (_SIDE - 1), cells * j / (_SIDE - 1), 1.0, 0.0
                for octave in range(3):
                    height += weight * noise(r.VALUE, x, y, seed + 10 * k + octave)
                    x, y, weight = 2 * x, 2 * y, gain * weight
                maps[k, i, j] = height
                largest = max(largest, abs(height))
        maps[k] /= max(largest, 1e-6)
    return maps

"""Random textures of a world: noise in matching colours, some with patterns on top."""

import colorsys
import math
from collections.abc import Mapping
from random import Random

import numpy as np
from numpy.typing import ArrayLike

from qgs.kernels import kernel
from qgs_worlds.caster import tables as s
from qgs_worlds.caster.textures import chance, noise
from qgs_worlds.worlds.things import TEXTURES, spread

# points of a height map along each axis
_SIDE = 33
_PLAIN_PATTERNS = (s.STRIPES, s.CHECKER, s.TILES, s.DOTS)
# a name that is listed twice is drawn more often
_PATTERNS = (*_PLAIN_PATTERNS, s.TILES, s.GLYPHS, s.GLYPHS, s.RINGS)

Color = tuple[float, ...]
Texture = Mapping[str, ArrayLike]
"""Values of a row of the table TEXTURE, by field name."""


class Palette:
    """Generator of random colours for one world, in linear RGB with matching hues."""

    def __init__(self, rng: Random) -> None:
        self.rng = rng
        base = rng.random()
        steps = (0, 0.06, 0.1, 0.5, 0.33)
        self._hues = [(base + step + 0.05 * rng.gauss(0, 1)) % 1 for step in steps]
        self._grey = rng.uniform(1.5, 7)

    def color(self) -> Color:
        """Return a random colour of this palette; dull colours are more frequent."""
        rng = self.rng
        hue = rng.choice(self._hues) if rng.random() < 0.8 else rng.random()
        saturation = rng.random() ** self._grey
        shown = colorsys.hsv_to_rgb(hue, saturation, 0.12 + 0.83 * rng.random())
        # from display to light
        return tuple(part**2.2 for part in shown)

    def near(self, color: Color, by: float) -> Color:
        """Return a random colour near `color`, with a slightly different hue.

        by: standard deviation of the brightness in stops (powers of 2).
        """
        tone = 2 ** self.rng.gauss(0, by)
        return tuple(min(tone * c * 2 ** self.rng.gauss(0, 0.25 * by), 0.9) for c in color)


def textures(rng: Random, varied: bool, highlights: bool) -> np.ndarray:
    """Return a table of TEXTURE with TEXTURES random rows.

    varied: True for noise, False for uniform surfaces and simple patterns. highlights: True makes
    some varied textures shiny, without other changes.
    """
    palette = Palette(rng)
    table = np.zeros(TEXTURES, s.TEXTURE)
    for row in table:
        fields = _varied(rng, palette, highlights) if varied else _plain(rng, palette)
        for name, value in fields.items():
            row[name] = value
        row["seed"] = rng.randrange(1 << 16)
    return table


def _plain(rng: Random, palette: Palette) -> Texture:
    """Return a random texture: a uniform colour, or a simple pattern of two colours."""
    base = palette.color()
    ramp = [palette.near(base, 0.1), base, palette.near(base, 0.1)]
    fields = {"octaves": 1, "period": rng.uniform(0.3, 1), "contrast": 0.6, "stretch": 1.0}
    mark = base
    if rng.random() >= 0.5:
        mark = palette.color()
        fields |= _pattern(rng, _PLAIN_PATTERNS)
    return {**fields, "colors": [*ramp, mark]}


def _pattern(rng: Random, kinds: tuple[int, ...]) -> dict[str, float]:
    kind = rng.choice(kinds)
    long = spread(rng, 0.25, 1) if kind == s.TILES else spread(rng, 0.6, 1.7)
    # lines of small letters
    glyphs = kind == s.GLYPHS
    return {
        "pattern": kind,
        "pattern_period": spread(rng, 0.06, 0.5) * (0.7 if glyphs else 1),
        "aspect": 1.6 if glyphs else long,
        "width": rng.uniform(0.15, 0.7),
        "strength": rng.uniform(0.4, 1),
        "tone": rng.choice((0.0, rng.uniform(0.2, 1.2))),
    }


def _varied(rng: Random, palette: Palette, highlights: bool) -> Texture:
    """Return a random texture of noise with a spectrum near 1/f.

    Some textures have a pattern on top, and some are nearly uniform.
    """
    base = palette.color()
    flat = rng.random() < 0.2
    by = 0.15 if flat else rng.uniform(0.5, 1.6)
    ramp = [palette.near(base, by), base, palette.near(base, by)]
    if not flat and rng.random() < 0.3:
        ramp[rng.randrange(3)] = palette.color()
    # cells are conspicuous, so they are rare
    basis = rng.choice((s.VALUE, s.VALUE, s.GRADIENT, s.GRADIENT, s.CELLS))
    octaves = 2 if basis == s.CELLS else rng.randint(3, 5)
    gain = rng.uniform(0.5, 0.85)
    # octaves add up to a similar contrast for any number of octaves
    norm = math.sqrt(sum(gain ** (2 * k) for k in range(octaves)))
    fields = {
        "basis": basis,
        "period": spread(rng, 0.15, 2),
        "octaves": octaves,
        "gain": gain,
        "contrast": rng.uniform(0.8, 2.2) / norm,
        "warp": rng.choice((0.0, rng.uniform(0.3, 2))),
        "stretch": rng.choice((1.0, 1.0, spread(rng, 0.12, 8))),
    }
    if rng.random() < 0.4:
        fields |= _pattern(rng, _PATTERNS)
    shiny = rng.random() < 0.25
    gloss = {"specular": spread(rng, 0.05, 0.8), "shine": spread(rng, 5, 150)}
    if highlights and shiny:
        fields |= gloss
    mark = palette.color()
    return {**fields, "colors": [*ramp, mark]}


@kernel
def height_maps(seed, count):
    """Return smooth random height maps (count, 33, 33) float32 in [-1, 1].

    The number of hills differs from map to map.
    """
    maps = np.empty((count, _SIDE, _SIDE), np.float32)
    for k in range(count):
        cells = 2.0 + 5.0 * chance(k, 0, seed)
        gain = 0.3 + 0.3 * chance(k, 1, seed)
        largest = 0.0
        for i in range(_SIDE):
            for j in range(_SIDE):
                x = cells * i / (_SIDE - 1)
                y = cells * j / (_SIDE - 1)
                weight = 1.0
                height = 0.0
                for octave in range(3):
                    height += weight * noise(s.VALUE, x, y, seed + 10 * k + octave)
                    x = 2 * x
                    y = 2 * y
                    weight = gain * weight
                maps[k, i, j] = height
                largest = max(largest, abs(height))
        # all maps use the whole range, as the scale of terrains assumes
        maps[k] /= max(largest, 1e-6)
    return maps

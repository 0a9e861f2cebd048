"""Materials of a room: textures whose colours go together."""

import colorsys
from collections.abc import Sequence
from random import Random

import numpy as np

from qgs_worlds.caster import patterns as s
from qgs_worlds.caster.tables import TEXTURE
from qgs_worlds.rooms.shapes import Color

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

    def __init__(self, rng: Random) -> None:
        self.rng = rng
        self.rows: list[tuple[int, float, int, float, Sequence[Color]]] = []
        # neighbours, an opposite and a third hue, which go together
        base = rng.random()
        self._hues = [(base + step + 0.04 * rng.gauss(0, 1)) % 1 for step in (0.0, 0.08, 0.5, 0.35)]
        self.wood = rng.choice(WOODS)

    def add(self, kind: int, period: float, colors: Sequence[Color], emission: float = 0.0) -> int:
        """Register a texture of three colours and return its index."""
        seed = int(self.rng.random() * 65536)
        self.rows.append((kind, period, seed, emission, colors))
        return len(self.rows) - 1

    def table(self, first: Sequence[int]) -> np.ndarray:
        """Return the table of TEXTURE of the ray caster: `first` of them, then all."""
        rows = [self.rows[i] for i in first] + self.rows
        table = np.zeros(len(rows), TEXTURE)
        kind, period, seed, emission, colors = zip(*rows, strict=True)
        table["pattern"] = kind
        table["period"] = period
        table["seed"] = seed
        table["emission"] = emission
        table["colors"][:, :3] = colors
        return table

    def color(self, saturation: tuple[float, float], value: tuple[float, float]) -> Color:
        """One of the room's hues at a random saturation and value."""
        pick, s, v = (self.rng.random() for _ in range(3))
        hue = self._hues[int(pick * len(self._hues))]
        (low_s, high_s) = saturation
        (low_v, high_v) = value
        return colorsys.hsv_to_rgb(hue, low_s + s * (high_s - low_s), low_v + v * (high_v - low_v))

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
        a = self.color((0.25, 0.8), (0.3, 0.9))
        b = self.color((0.1, 0.7), (0.5, 0.98))
        return self.add(kind, self.rng.uniform(0.1, 0.3), (a, b, WHITE))

    def books(self) -> int:
        """A row of spines."""
        a = self.color((0.4, 0.9), (0.2, 0.5))
        b = self.color((0.2, 0.8), (0.6, 0.95))
        return self.add(s.BOOKS, self.rng.uniform(0.03, 0.06), (a, b, WHITE))

    def picture(self) -> int:
        """A landscape for a frame."""
        sky = self.color((0.2, 0.6), (0.7, 0.95))
        land = self.color((0.4, 0.9), (0.2, 0.5))
        return self.add(s.PICTURE, 1.0, (sky, (0.98, 0.92, 0.7), land), 0.1)

    def rug(self) -> int:
        """A woven rug with borders."""
        a = self.color((0.4, 0.85), (0.3, 0.7))
        b = self.color((0.1, 0.4), (0.75, 0.95))
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
        # bricks are rare, patterns less so
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
            wood = rng.choice(WOODS)
            colors = (toned(wood, 0.75), toned(wood, 1.1), toned(wood, 0.45))
            return self.add(s.PLANKS, rng.uniform(0.12, 0.3), colors)
        if pick < 0.85:
            kind = rng.choice([s.TILES, s.CHECKER])
            color = self.color((0.05, 0.4), (0.5, 0.9))
            colors = (toned(color, 0.7), toned(color, 1.1), toned(color, 0.5))
            return self.add(kind, rng.uniform(0.3, 0.6), colors)
        color = self.color((0.2, 0.6), (0.35, 0.7))
        return self.add(s.CLOUDS, 0.25, (toned(color, 0.85), toned(color, 1.1), color))

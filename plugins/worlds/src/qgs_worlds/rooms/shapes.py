"""Rows of numbers that describe shapes and textures to the ray caster.

World frame: metres, x and y along the walls, z up, the floor at z = 0, the room centred on the
z axis. A shape is upright; it may be turned about z.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

BOX, SPHERE, CYLINDER = range(3)
SHAPE_FIELDS = 10  # kind, centre x y z, half sizes x y z, cos and sin of the turn, texture
TEXTURE_FIELDS = 13  # kind, period, seed, emission, RGB of three colours
(PLAIN, CHECKER, STRIPES, PLANKS, TILES, BRICKS, CLOUDS, GRADIENT, PICTURE, RUG, WINDOW, DOTS,
 BOOKS) = range(13)  # fmt: skip

Color = tuple[float, float, float]


class Shape(NamedTuple):
    """One shape; `half` is the half size along each axis, radii for round ones."""

    kind: int
    center: tuple[float, float, float]
    half: tuple[float, float, float]
    turn: float
    texture: int

    def moved(self, x: float, y: float, turn: float) -> "Shape":
        """The shape turned by `turn` radians about the origin, then moved by (x, y)."""
        cos, sin = math.cos(turn), math.sin(turn)
        cx, cy, cz = self.center
        center = (x + cos * cx - sin * cy, y + sin * cx + cos * cy, cz)
        return Shape(self.kind, center, self.half, self.turn + turn, self.texture)

    def bounds(self) -> tuple[float, float, float, float, float, float]:
        """Lowest x, y, z and highest x, y, z."""
        (x, y, z), (a, b, c) = self.center, self.half
        if self.turn:
            cos, sin = abs(math.cos(self.turn)), abs(math.sin(self.turn))
            a, b = cos * a + sin * b, sin * a + cos * b
        return x - a, y - b, z - c, x + a, y + b, z + c

    def row(self) -> tuple[float, ...]:
        """The `SHAPE_FIELDS` numbers of the ray caster."""
        turned = (math.cos(self.turn), math.sin(self.turn))
        return (self.kind, *self.center, *self.half, *turned, self.texture)


def box(x: float, y: float, z: float, size: tuple[float, float, float], texture: int) -> Shape:
    """A box whose bottom centre is (x, y, z), of full `size`."""
    w, d, h = size
    return Shape(BOX, (x, y, z + h / 2), (w / 2, d / 2, h / 2), 0.0, texture)


def cylinder(x: float, y: float, z: float, radius: float, height: float, texture: int) -> Shape:
    """An upright cylinder whose bottom centre is (x, y, z)."""
    half = (radius, radius, height / 2)
    return Shape(CYLINDER, (x, y, z + height / 2), half, 0.0, texture)


def sphere(x: float, y: float, z: float, radius: float, texture: int) -> Shape:
    """A sphere whose lowest point is (x, y, z)."""
    return Shape(SPHERE, (x, y, z + radius), (radius, radius, radius), 0.0, texture)


@dataclass(frozen=True)
class Room:
    """A furnished room, ready to be cast.

    shapes: (S, SHAPE_FIELDS) float32. textures: (T, TEXTURE_FIELDS) float64; the first six are
    those of the walls -x, +x, -y, +y, the floor and the ceiling. size: x, y, z extent in metres.
    lights: (2, 4) position and strength of the lamp and of the window.
    """

    shapes: np.ndarray
    textures: np.ndarray
    size: tuple[float, float, float]
    lights: np.ndarray

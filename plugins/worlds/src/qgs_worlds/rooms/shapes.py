"""Shapes of a furnished room.

World frame: metres, x and y along the walls, z up, the floor at z = 0, the room centred on the
z axis. A shape is upright; it may be turned about z.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from qgs_worlds.caster import tables as s

Point = tuple[float, float, float]

# Surfaces of a room: -x, +x, -y, +y, floor and ceiling.
WALLS = 6


class Shape(NamedTuple):
    """One shape; `half` is the half size along each axis, radii for round ones."""

    kind: int
    center: Point
    half: Point
    turn: float
    texture: int

    def moved(self, x: float, y: float, turn: float) -> "Shape":
        """Return the shape turned by `turn` radians about the origin, then moved by (x, y)."""
        cos = math.cos(turn)
        sin = math.sin(turn)
        cx, cy, cz = self.center
        center = (x + cos * cx - sin * cy, y + sin * cx + cos * cy, cz)
        return Shape(self.kind, center, self.half, self.turn + turn, self.texture)

    def bounds(self) -> tuple[float, ...]:
        """Return the lowest x, y, z and the highest of the box around it."""
        x, y, z = self.center
        a, b, c = self.half
        # most shapes are not turned, and bounds are asked for often
        if self.turn:
            cos = abs(math.cos(self.turn))
            sin = abs(math.sin(self.turn))
            a, b = cos * a + sin * b, sin * a + cos * b
        return x - a, y - b, z - c, x + a, y + b, z + c


def box(x: float, y: float, z: float, w: float, d: float, h: float, texture: int) -> Shape:
    """Return a box whose bottom centre is (x, y, z), w wide along x, d along y and h high."""
    return Shape(s.BLOCK, (x, y, z + h / 2), (w / 2, d / 2, h / 2), 0.0, texture)


def cylinder(x: float, y: float, z: float, radius: float, height: float, texture: int) -> Shape:
    """Return an upright cylinder whose bottom centre is (x, y, z)."""
    half = (radius, radius, height / 2)
    return Shape(s.CYLINDER, (x, y, z + height / 2), half, 0.0, texture)


def sphere(x: float, y: float, z: float, radius: float, texture: int) -> Shape:
    """Return a sphere whose lowest point is (x, y, z)."""
    return Shape(s.BALL, (x, y, z + radius), (radius, radius, radius), 0.0, texture)


def packed(size: Point, shapes: Sequence[Shape]) -> np.ndarray:
    """Return the table of SHAPE of the ray caster for a room of a size and what is in it.

    Textures of its walls, floor and ceiling come first, those of the shapes after them.
    """
    walls = Shape(s.INTERIOR, (0.0, 0.0, 0.0), (size[0] / 2, size[1] / 2, size[2]), 0.0, -WALLS)
    kind, center, half, angle, texture = map(np.array, zip(walls, *shapes, strict=True))
    turn = np.zeros((len(kind), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = [math.cos(a) for a in angle]
    turn[:, 1, 0] = [math.sin(a) for a in angle]
    turn[:, 0, 1] = -turn[:, 1, 0]
    turn[:, 2, 2] = 1
    table = np.zeros(len(kind), s.SHAPE)
    table["body"] = s.primitives(kind, np.zeros(len(kind)), center, half, turn)
    table["cut"]["kind"] = s.NOTHING
    table["texture"] = texture + WALLS
    return table

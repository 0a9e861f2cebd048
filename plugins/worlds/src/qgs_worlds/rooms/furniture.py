"""Random pieces of furniture: lists of shapes around the origin, with the back towards +y.

The world frame of a room is in metres: x and y along the walls, z up, the floor at z = 0. The z
axis goes through the centre of the room. Shapes are upright and may be turned about z.
"""

import math
import re
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np

from qgs_worlds.caster import shapes
from qgs_worlds.caster import tables as s
from qgs_worlds.caster.shapes import Point, Primitive, Shape, about_z
from qgs_worlds.rooms.materials import Materials, between, kinds_beside

# Surfaces of a room: -x, +x, -y, +y, floor and ceiling.
WALLS = 6


def solid(at: Sequence[float], size: Sequence[float], texture: int, kind: int = s.BLOCK) -> Shape:
    """Return an upright solid that is not turned. Lengths are in metres.

    at: centre of its bottom. size: width (along x), depth (along y) and height. texture: index of a
    material. kind: BLOCK, CYLINDER or BALL; width and depth of the last two are equal.
    """
    x, y, z = at
    w, d, h = size
    body = Primitive(kind, (x, y, z + h / 2), (w / 2, d / 2, h / 2))
    return Shape(body, texture=texture + WALLS)


def _turned(shape: Shape, angle: float) -> Shape:
    """Return a shape turned by `angle` radians about its own z axis, in place of its own turn."""
    return shape._replace(body=shape.body._replace(turn=about_z(angle)))


def packed(size: Point, inside: Sequence[Shape]) -> np.ndarray:
    """Return a table of SHAPE for the ray caster: first the room itself, then the shapes in it.

    size: x, y, z extent of the room in metres. Textures 0 to 5 are those of walls, floor and
    ceiling; textures of the other shapes follow from 6 on.
    """
    walls = Primitive(s.INTERIOR, (0.0, 0.0, 0.0), (size[0] / 2, size[1] / 2, size[2]))
    return shapes.packed([Shape(walls), *inside])


Piece = list[Shape]
Sizes = dict[str, Any]
"""Values of the names in `furniture.toml`: lengths in metres and indices of materials."""

_ORNAMENTS = ("vase", "globe", "table_lamp", "pile", "cube")
# a name that is listed twice is drawn more often
AGAINST_WALLS = (
    "shelf", "sofa", "sideboard", "wardrobe", "shelf", "sideboard", "plant", "floor_lamp", "crates",
)  # fmt: skip
CENTRAL = ("table", "table", "round_table")
LOOSE = ("balls", "chair", "crates", "plant", "floor_lamp", "round_table")

# metres between the boards of a shelf
_LEVEL = 0.38


# Rooms are drawn often.
@cache
def _terms(value: float | str) -> list[tuple[float, str]]:
    """Parse a sum of lengths such as "h-0.3r" into pairs (factor, name of a length).

    The name of a plain number is "".
    """
    found = re.findall(r"([+-]?)(?=[\d.a-z])([\d.]*)([a-z]*)", str(value))
    return [(float(f"{sign}{factor or 1}"), name) for sign, factor, name in found]


def _lengths(values: list[Any], sizes: Sizes) -> list[float]:
    return [
        sum([factor * sizes.get(name, 1.0) for factor, name in terms])
        for terms in map(_terms, values)
    ]


_KINDS = kinds_beside(__file__)
_SOLIDS = {"box": s.BLOCK, "cylinder": s.CYLINDER, "sphere": s.BALL}


class Furniture(Materials):
    """Generator of random furniture for one room, of the kinds in furniture.toml."""

    def piece(self, name: str, **sizes: Any) -> Piece:
        """Return a random piece of furniture of the kind `name` in furniture.toml.

        sizes: lengths and materials to use instead of random ones, by their names in the file.
        """
        kind = _KINDS[name]
        for drawn, how in kind.get("draws", {}).items():
            if drawn not in sizes:
                sizes[drawn] = self._drawn(how)
        piece: Piece = []
        for shape, at, extent, material, *turn in kind.get("parts", []):
            size = _lengths(extent, sizes)
            part = solid(_lengths(at, sizes), size, sizes[material], _SOLIDS[shape])
            piece.append(_turned(part, sizes[turn[0]]) if turn else part)
        if "some" in kind:
            for _ in range(self.rng.choice(kind["some"]["count"])):
                piece += self.piece(kind["some"]["piece"], **sizes)
        if name in _MORE:
            piece += _MORE[name](self, sizes)
        for chance, *at in kind.get("tops", []):
            if chance == 1 or self.rng.random() < chance:
                piece += self.ornament(*_lengths(at, sizes))
        return piece

    def ornament(self, x: float, y: float, z: float) -> Piece:
        """Return a random small ornament that stands at (x, y, z)."""
        return self.piece(self.rng.choice(_ORNAMENTS), x=x, y=y, z=z)

    def _drawn(self, how: Any) -> float:
        if isinstance(how, str):
            return self.material(how)
        if isinstance(how, list):
            return between(self.rng, how)
        if "among" in how:
            return self.rng.choice(how["among"])
        pick = self.rng.random()
        return self.material(next(name for name, below in how.items() if pick < below))

    def spots(self, most: float) -> list[float]:
        """Return one to three random positions along the width of a piece, relative to this width.

        0 is the middle; positions are from -most to most.
        """
        return [self.rng.uniform(-most, most) for _ in range(self.rng.randrange(1, 4))]


def _around_table(make: Furniture, sizes: Sizes) -> Iterator[Shape]:
    """Yield chairs around a table, and random ornaments on the table, without the table itself."""
    rng = make.rng
    w = sizes["w"]
    d = sizes["d"]
    for x in make.spots(0.38):
        yield from make.ornament(x * w, rng.uniform(-0.3, 0.3) * d, sizes["h"])
    # chairs around one table are alike
    alike = {"seat": make.material("fabric"), "frame": make.material("timber")}
    for sign, turn in ((1, 0.0), (-1, math.pi)):
        for x in (-w / 4, w / 4):
            if rng.random() < 0.75:
                away = sign * (d / 2 + rng.uniform(0.0, 0.2))
                at = (sign * x, away, 0.0)
                for part in make.piece("chair", **alike):
                    yield part.moved(turn, at)


def _cushions(make: Furniture, sizes: Sizes) -> Iterator[Shape]:
    for x in make.spots(0.32):
        (cushion,) = make.piece("cushion", x=x * sizes["w"])
        yield _turned(cushion, make.rng.gauss(0, 0.15))


def _books(make: Furniture, sizes: Sizes) -> Iterator[Shape]:
    """Yield the boards of a shelf, with rows of books and a few balls on the boards."""
    rng = make.rng
    w = sizes["w"]
    levels = sizes["n"]
    for i in range(levels + 1):
        # the top board ends at the height of the sides
        z = min(i * _LEVEL, levels * _LEVEL - 0.03)
        yield solid((0, 0, z), (w, 0.32, 0.03), sizes["wood"])
    for i in range(levels):
        z = i * _LEVEL + 0.03
        left = -w / 2 + 0.04
        while left < w / 2 - 0.3:
            run = rng.uniform(0.18, 0.45)
            x = left + run / 2
            if rng.random() < 0.72:
                size = (run - 0.02, 0.22, rng.uniform(0.2, 0.3))
                yield solid((x, 0.02, z), size, make.material("books"))
            else:
                size = [rng.uniform(0.12, 0.18)] * 3
                yield solid((x, 0, z), size, make.material("paint"), s.BALL)
            left += run


def _doors(make: Furniture, sizes: Sizes) -> Iterator[Shape]:
    h = sizes["h"]
    doors = make.rng.randrange(2, 4)
    wide = sizes["w"] / doors
    for i in range(doors):
        x = (i + 0.5) * sizes["w"] / doors - sizes["w"] / 2
        yield solid((x, -0.21, 0.12), (wide - 0.04, 0.03, h - 0.18), sizes["front"])
        knob = (x + 0.3 * wide, -0.24, h / 2)
        yield solid(knob, (0.05, 0.05, 0.05), sizes["knob"], s.BALL)


# Functions that add to the parts of a piece in the file.
_MORE = {"table": _around_table, "sofa": _cushions, "shelf": _books, "sideboard": _doors}

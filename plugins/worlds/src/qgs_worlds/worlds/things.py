"""Random objects: composites of primitives, cut primitives, rows, frames, bars and wires."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations, pairwise, product
from operator import add, ne
from random import Random
from typing import NamedTuple

from qgs_worlds.caster import tables as s
from qgs_worlds.caster.shapes import (
    UPRIGHT,
    Point,
    Primitive,
    Shape,
    Turn,
    about_z,
    any_turn,
    rod,
    rotated,
)

# textures and height maps of a world
TEXTURES = 14
MAPS = 4

Thing = list[Shape]


def spread(rng: Random, low: float, high: float) -> float:
    """Return a log-uniform random number between `low` and `high`."""
    return low * (high / low) ** rng.random()


def any_angle(rng: Random) -> float:
    """Return a random angle from 0 to 2 pi."""
    return rng.uniform(0, math.tau)


class Style(NamedTuple):
    """Distribution of the shapes of random objects.

    kinds: kinds of primitives to choose from; a kind that is listed twice is chosen twice as often.
    tilted: share of primitives with a random 3D rotation. cut: share of composites with a piece cut
    out of their primitives. wired: share of objects made of rods: frames, wires and bars. repeated:
    share of objects that repeat a shape in a row. even: True gives round primitives circular cross
    sections, and makes ellipsoids spheres. most: largest number of primitives in an object.
    """

    kinds: tuple[int, ...]
    tilted: float
    cut: float
    wired: float
    repeated: float
    even: bool
    most: int


PLAIN = Style((s.BOX, s.BOX, s.ELLIPSOID, s.FRUSTUM), 0.0, 0.0, 0.0, 0.0, True, 5)
VARIED = Style(
    (s.BOX, s.BOX, s.BOX, s.ELLIPSOID, s.ELLIPSOID, s.FRUSTUM, s.FRUSTUM, s.CAPSULE, s.TORUS,
     s.HEIGHT),
    0.45, 0.35, 0.15, 0.12, False, 8,
)  # fmt: skip


@dataclass
class Things:
    """Generator of random objects, about 2 units in size, around the origin.

    A shape uses one of the TEXTURES of a world, or six consecutive textures, one for each face.
    """

    rng: Random
    style: Style

    def texture(self) -> tuple[int, int]:
        """Return random textures for a shape: index of the first, and their number, 1 or 6.

        Six textures have consecutive indices; each is for one face.
        """
        faces = 6 if self.rng.random() < 0.3 else 1
        # five more textures follow the first one if there are six faces
        return self.rng.randrange(TEXTURES - 5), faces

    def skinned(self, body: Primitive, scale: float = 1.0) -> Shape:
        """Return the primitive `body` as a shape with random textures.

        scale: metres per unit of a texture.
        """
        first, faces = self.texture()
        return Shape(body, None, first, faces, self.rng.randrange(TEXTURES), scale)

    def draw(self) -> Thing:
        """Return a random object: a composite, a row, a frame, a wire or bars."""
        # one number for both shares
        pick = self.rng.random() - self.style.wired
        if pick < 0:
            return self.rng.choice((self._frame, self._wire, self._bars))()
        pick -= self.style.repeated
        return self._row() if pick < 0 else self._composite()

    def _turn(self) -> Turn:
        if self.rng.random() < self.style.tilted:
            return any_turn(self.rng)
        return about_z(any_angle(self.rng)) if self.rng.random() < 0.5 else UPRIGHT

    def _primitive(self, center: Point, size: float) -> Primitive:
        rng = self.rng
        kind = rng.choice(self.style.kinds)
        a, b, c = (size * spread(rng, 0.25, 1.0) for _ in range(3))
        if self.style.even and kind != s.BOX:
            a = b = min(a, b)
            c = a if kind == s.ELLIPSOID else c
        extra = 1.0
        if kind == s.FRUSTUM and not self.style.even:
            extra = rng.choice((0.001, 1.0, rng.random()))
        if kind == s.CAPSULE:
            a = b = c = 0.6 * min(a, b)
            extra = rng.uniform(0.3, 3)
        if kind == s.TORUS:
            b = c = a
            extra = rng.uniform(0.1, 0.4)
        if kind == s.HEIGHT:
            extra = rng.randrange(MAPS)
        return Primitive(kind, center, (a, b, c), self._turn(), extra)

    def _cut(self, body: Primitive) -> Primitive | None:
        """Return a random primitive to cut from `body`, or None for kinds that cannot be cut."""
        # cuts need exits, which these kinds do not have
        if body.kind in (s.TORUS, s.HEIGHT):
            return None
        rng = self.rng
        way = rotated(body.turn, tuple(rng.uniform(-0.8, 0.8) * h for h in body.half))
        center = tuple(map(add, body.center, way))
        kind = rng.choice((s.BOX, s.ELLIPSOID, s.FRUSTUM))
        half = tuple(h * rng.uniform(0.35, 0.9) for h in body.half)
        turn = body.turn if rng.random() < 0.5 else any_turn(rng)
        return Primitive(kind, center, half, turn, rng.uniform(0.2, 1))

    def _composite(self) -> Thing:
        rng = self.rng
        # rounding may reach the upper end, which would be one too many
        count = min(int(spread(rng, 1, self.style.most + 1)), self.style.most)
        cut = rng.random() < self.style.cut
        thing = []
        skin = self.texture()
        for _ in range(count):
            reach = 0.6 if count > 1 else 0.0
            x, y, z = (rng.uniform(-reach, reach) for _ in range(3))
            body = self._primitive((x, y, z), 1.0 if count == 1 else rng.uniform(0.4, 0.9))
            # parts of a thing often have the same texture
            skin = skin if rng.random() < 0.4 else self.texture()
            hole = self._cut(body) if cut else None
            inner = skin[0] if rng.random() < 0.5 else rng.randrange(TEXTURES)
            thing.append(Shape(body, hole, *skin, inner))
        return thing

    def _row(self) -> Thing:
        """Repeat one random shape along a line. Size and direction may change from copy to copy."""
        rng = self.rng
        count = rng.randint(3, 7)
        first = self.skinned(self._primitive((0.0, 0.0, 0.0), 1.2 / count))
        # values that stand twice are likelier: most rows are level, straight and of one size
        way = rotated(self._turn(), (2.0 / count, 0.0, rng.choice((0.0, 0.0, 1.2 / count))))
        angle = rng.choice((0.0, 0.0, rng.uniform(-0.5, 0.5)))
        grow = rng.choice((1.0, 1.0, rng.uniform(0.8, 1.2)))
        places = [k - (count - 1) / 2 for k in range(count)]
        return [first.moved(s * angle, tuple(s * part for part in way), grow**s) for s in places]

    def _rods(self, ends: Iterable[tuple[Point, Point]], radius: float) -> Thing:
        square = self.rng.random() < 0.5
        texture, _ = self.texture()
        return [Shape(rod(a, b, radius, square), texture=texture) for a, b in ends]

    def _frame(self) -> Thing:
        """Return the edges of a random box, as rods."""
        rng = self.rng
        a, b, c = (rng.uniform(0.4, 1) for _ in range(3))
        corners = product((-a, a), (-b, b), (-c, c))
        # corners that share an edge differ in one coordinate
        edges = [pair for pair in combinations(corners, 2) if sum(map(ne, *pair)) == 1]
        return self._rods(edges, spread(rng, 0.012, 0.08))

    def _wire(self) -> Thing:
        """Return a chain of rods, along an arc or through random points."""
        rng = self.rng
        count = rng.randint(3, 8)
        if rng.random() < 0.5:
            bend = rng.uniform(1, 6)
            lift = rng.uniform(-0.3, 0.3)
            angles = [bend * k / (count - 1) for k in range(count)]
            points = [(math.cos(t), math.sin(t), lift * t) for t in angles]
        else:
            points = [tuple(rng.uniform(-1, 1) for _ in range(3)) for _ in range(count)]
        return self._rods(pairwise(points), spread(rng, 0.008, 0.05))

    def _bars(self) -> Thing:
        """Return parallel bars between two rails, like a fence or a ladder."""
        rng = self.rng
        count = rng.randint(3, 9)
        high = rng.uniform(0.4, 1)
        rails = [((-1.0, 0.0, z), (1.0, 0.0, z)) for z in (-0.8 * high, 0.8 * high)]
        places = [2 * (k + 0.5) / count - 1 for k in range(count)]
        bars = [((x, 0.0, -high), (x, 0.0, high)) for x in places]
        return self._rods(rails + bars, spread(rng, 0.012, 0.06))


def lowest(thing: Thing) -> float:
    """Return a close lower bound of the z of all points of an object."""
    return min(shape.body.center[2] - shape.body.reach() for shape in thing)


def placed(thing: Thing, to: Point, turn: float, size: float) -> Thing:
    """Return an object scaled by `size`, turned about z by `turn` radians and placed at `to`.

    to: x, y, and the height of the object's lowest point, in metres.
    """
    place = (to[0], to[1], to[2] - lowest(thing) * size)
    return [shape.moved(turn, place, size) for shape in thing]

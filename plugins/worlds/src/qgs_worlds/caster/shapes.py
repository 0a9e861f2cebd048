"""Primitives and shapes of scenes, and their conversion to tables for the ray caster."""

import math
from collections.abc import Sequence
from itertools import chain
from random import Random
from typing import NamedTuple

import numpy as np

from qgs_worlds.caster import tables as s

Point = tuple[float, ...]
Turn = tuple[float, ...]
"""Rotation matrix as nine numbers, row by row."""
UPRIGHT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
ROUND = (s.ELLIPSOID, s.CAPSULE, s.TORUS)


class Primitive(NamedTuple):
    """Solid of a given kind, such as a box or a torus.

    half: half sizes in metres. turn: rotation from the primitive's frame to the world frame. extra:
    a further size of some kinds, such as the thickness of a torus; see `PRIMITIVE` in tables.py.
    """

    kind: int
    center: Point
    half: Point
    turn: Turn = UPRIGHT
    extra: float = 0.0

    def moved(self, to: Point, turn: Turn, size: float) -> "Primitive":
        """Return the primitive scaled by `size` about the origin, turned, then moved by `to`."""
        turned = rotated(turn, self.center)
        center = tuple(start + size * way for start, way in zip(to, turned, strict=True))
        half = tuple(size * part for part in self.half)
        return Primitive(self.kind, center, half, product(turn, self.turn), self.extra)

    def reach(self) -> float:
        """Return the height of the primitive's highest point above its centre, in metres."""
        size = self.half[2]
        up = abs(self.turn[8])
        if self.kind == s.CAPSULE:
            return size * (1 + up * self.extra)
        if self.kind == s.TORUS:
            return size * ((1 - self.extra) * math.sqrt(max(1 - up * up, 0.0)) + self.extra)
        a, b, c = (t * half for t, half in zip(self.turn[6:], self.half, strict=True))
        if self.kind == s.ELLIPSOID:
            return math.hypot(a, b, c)
        # a frustum counts as a cylinder: `lowest` needs only a bound
        return abs(c) + (math.hypot(a, b) if self.kind == s.FRUSTUM else abs(a) + abs(b))


class Shape(NamedTuple):
    """Solid shape: the primitive `body`, from which the primitive `cut` is removed if it is given.

    texture: index of the body's first texture. faces: number of the body's textures, one per face.
    cut_texture: texture of the cut's wall. scale: metres per unit of a texture.
    """

    body: Primitive
    cut: Primitive | None = None
    texture: int = 0
    faces: int = 1
    cut_texture: int = 0
    scale: float = 1.0

    def moved(self, angle: float, to: Point = (0.0, 0.0, 0.0), size: float = 1.0) -> "Shape":
        """Return the shape scaled by `size`, turned about the z axis, then moved by `to`.

        angle: of the turn, in radians. The origin is the centre of scaling.
        """
        turn = about_z(angle)
        cut = self.cut and self.cut.moved(to, turn, size)
        body = self.body.moved(to, turn, size)
        return self._replace(body=body, cut=cut, scale=self.scale * size)


def rotated(turn: Turn, p: Point) -> Point:
    """Return the point p, rotated by `turn`."""
    a, b, c, d, e, f, g, h, i = turn
    x, y, z = p
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def product(a: Turn, b: Turn) -> Turn:
    """Return the matrix product a b, which rotates by b first, then by a."""
    columns = [rotated(a, b[axis::3]) for axis in range(3)]
    return tuple(chain(*zip(*columns, strict=True)))


def about_z(angle: float) -> Turn:
    """Return a rotation by `angle` radians about the z axis."""
    cos = math.cos(angle)
    sin = math.sin(angle)
    return cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0


def any_turn(rng: Random) -> Turn:
    """Return a random rotation; all rotations are equally likely."""
    # normal distributions prefer no direction
    w, x, y, z = (rng.gauss(0, 1) for _ in range(4))
    f = 2 / (w * w + x * x + y * y + z * z)
    return (
        1 - f * (y * y + z * z), f * (x * y - w * z), f * (x * z + w * y),
        f * (x * y + w * z), 1 - f * (x * x + z * z), f * (y * z - w * x),
        f * (x * z - w * y), f * (y * z + w * x), 1 - f * (x * x + y * y),
    )  # fmt: skip


def rod(start: Point, end: Point, radius: float, square: bool = False) -> Primitive:
    """Return a bar from `start` to `end`.

    radius: half the thickness in metres. square: True for a square section, False for a round one.
    """
    x, y, z = (b - a for a, b in zip(start, end, strict=True))
    # two equal points must not divide by 0
    length = math.sqrt(x * x + y * y + z * z) + 1e-9
    x = x / length
    y = y / length
    z = z / length
    flat = math.hypot(x, y)
    # an upright bar has no level direction of its own
    u, v = (-y / flat, x / flat) if flat > 1e-6 else (1.0, 0.0)
    # columns: level, across both, along the bar
    turn = (u, -v * z, x, v, u * z, y, 0.0, v * x - u * y, z)
    middle = tuple(0.5 * (a + b) for a, b in zip(start, end, strict=True))
    half = (radius, radius, 0.5 * length if square else radius)
    kind = s.BOX if square else s.CAPSULE
    return Primitive(kind, middle, half, turn, 0.0 if square else 0.5 * length / radius)


def packed(shapes: Sequence[Shape]) -> np.ndarray:
    """Return the shapes as an array of dtype SHAPE for the ray caster, one row for each shape."""
    table = np.zeros(len(shapes), s.SHAPE)
    body = _primitives([shape.body for shape in shapes])
    table["body"] = body
    table["cut"]["kind"] = s.NOTHING
    holes = [shape.cut for shape in shapes if shape.cut]
    if holes:
        table["cut"][[shape.cut is not None for shape in shapes]] = _primitives(holes)
    sizes = body["extent"] * body["unit"]
    # round kinds have no corners that stick out of a sphere of their largest half size
    is_round = np.isin(body["kind"], ROUND)
    table["radius"] = np.where(is_round, sizes.max(1), np.linalg.norm(sizes, axis=1))
    for field in ("texture", "faces", "cut_texture", "scale"):
        table[field] = [getattr(shape, field) for shape in shapes]
    return table


def _primitives(primitives: Sequence[Primitive]) -> np.ndarray:
    """Return the primitives as an array of dtype PRIMITIVE, one row for each primitive."""
    kind, center, half, turn, extra = map(np.array, zip(*primitives, strict=True))
    metric = (kind >= s.BLOCK)[:, None]
    unit = np.where(metric, 1.0, half)
    extent = np.where(metric, half, 1.0)
    extent[kind == s.CAPSULE, 2] += extra[kind == s.CAPSULE]
    extent[kind == s.TORUS, 2] = extra[kind == s.TORUS]
    table = np.zeros(len(kind), s.PRIMITIVE)
    table["kind"] = kind
    table["extra"] = extra
    # the transpose of a rotation is its inverse: axes lead from the world to the primitive
    table["axes"] = turn.reshape(-1, 3, 3).transpose(0, 2, 1) / unit[:, :, None]
    table["center"] = center
    table["unit"] = unit
    table["extent"] = extent
    return table

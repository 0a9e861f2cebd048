"""Primitives, shapes made of one or two of them, and the rows that they fill."""

import math
from collections.abc import Sequence
from random import Random
from typing import NamedTuple

import numpy as np

from qgs_worlds import rows as r

Point = tuple[float, float, float]
Turn = tuple[float, float, float, float, float, float, float, float, float]
UPRIGHT: Turn = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
ROUND = (r.ELLIPSOID, r.CAPSULE, r.TORUS)


class Primitive(NamedTuple):
    """A primitive: `rows` says what `extra` is; `turn` is a rotation to the world, row by row."""

    kind: int
    center: Point
    half: Point
    turn: Turn = UPRIGHT
    extra: float = 0.0

    def moved(self, to: Point, turn: Turn, size: float) -> "Primitive":
        """Scaled about the origin, turned, then moved."""
        x, y, z = rotated(turn, self.center)
        center = (to[0] + size * x, to[1] + size * y, to[2] + size * z)
        a, b, c = self.half
        half = (size * a, size * b, size * c)
        return Primitive(self.kind, center, half, product(turn, self.turn), self.extra)

    def reach(self) -> float:
        """How far it extends up and down from its centre, metres, at most."""
        size, up = self.half[2], abs(self.turn[8])
        if self.kind == r.CAPSULE:
            return size * (1 + up * self.extra)
        if self.kind == r.TORUS:
            return size * ((1 - self.extra) * math.sqrt(max(1 - up * up, 0.0)) + self.extra)
        a, b, c = (t * half for t, half in zip(self.turn[6:], self.half, strict=True))
        if self.kind == r.ELLIPSOID:
            return math.hypot(a, b, c)
        return abs(c) + (math.hypot(a, b) if self.kind == r.FRUSTUM else abs(a) + abs(b))


class Shape(NamedTuple):
    """A primitive less another one. faces: textures from `texture` on, one a face."""

    body: Primitive
    cut: Primitive | None = None
    texture: int = 0
    faces: int = 1
    cut_texture: int = 0
    scale: float = 1.0

    def moved(self, to: Point, turn: Turn, size: float = 1.0) -> "Shape":
        """See `Primitive.moved`."""
        cut = self.cut and self.cut.moved(to, turn, size)
        body = self.body.moved(to, turn, size)
        return self._replace(body=body, cut=cut, scale=self.scale * size)


def rotated(turn: Turn, p: Point) -> Point:
    """A rotation of a point."""
    a, b, c, d, e, f, g, h, i = turn
    x, y, z = p
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def product(a: Turn, b: Turn) -> Turn:
    """The rotation by b, then by a."""
    x = rotated(a, (b[0], b[3], b[6]))
    y = rotated(a, (b[1], b[4], b[7]))
    z = rotated(a, (b[2], b[5], b[8]))
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


def about_z(angle: float) -> Turn:
    """A rotation about the vertical."""
    cos, sin = math.cos(angle), math.sin(angle)
    return cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0


def any_turn(rng: Random) -> Turn:
    """A rotation drawn evenly from all (a random unit quaternion)."""
    w, x, y, z = (rng.gauss(0, 1) for _ in range(4))
    s = 2 / (w * w + x * x + y * y + z * z)
    return (
        1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y),
    )  # fmt: skip


def rod(start: Point, end: Point, radius: float, square: bool = False) -> Primitive:
    """A round or square bar between two points."""
    x, y, z = (b - a for a, b in zip(start, end, strict=True))
    length = math.sqrt(x * x + y * y + z * z) + 1e-9
    x, y, z = x / length, y / length, z / length
    flat = math.hypot(x, y)
    u, v = (-y / flat, x / flat) if flat > 1e-6 else (1.0, 0.0)
    # columns: level, across both, along the bar
    turn = (u, -v * z, x, v, u * z, y, 0.0, v * x - u * y, z)
    middle = tuple(0.5 * (a + b) for a, b in zip(start, end, strict=True))
    half = (radius, radius, 0.5 * length if square else radius)
    kind = r.BOX if square else r.CAPSULE
    return Primitive(kind, middle, half, turn, 0.0 if square else 0.5 * length / radius)  # type: ignore[arg-type]


def packed(shapes: Sequence[Shape]) -> np.ndarray:
    """(S, SHAPE_FIELDS) float32."""
    table = np.zeros((len(shapes), r.SHAPE_FIELDS))
    _fill(table[:, : r.PRIMITIVE_FIELDS], [shape.body for shape in shapes])
    second = table[:, r.PRIMITIVE_FIELDS : 2 * r.PRIMITIVE_FIELDS]
    second[:, r.KIND] = r.NOTHING
    cut = [i for i, shape in enumerate(shapes) if shape.cut]
    holes = np.zeros((len(cut), r.PRIMITIVE_FIELDS))
    _fill(holes, [shape.cut for shape in shapes if shape.cut])
    second[cut] = holes
    kind, extra = table[:, r.KIND], table[:, r.EXTRA]
    extent = np.ones((len(shapes), 3))
    extent[kind == r.CAPSULE, 2] += extra[kind == r.CAPSULE]
    extent[kind == r.TORUS, 2] = extra[kind == r.TORUS]
    table[:, r.EXTENT : r.EXTENT + 3] = extent
    sizes = extent * table[:, r.HALF : r.HALF + 3]
    around = np.where(np.isin(kind, ROUND), sizes.max(1), np.linalg.norm(sizes, axis=1))
    table[:, r.SPHERE : r.SPHERE + 3] = table[:, r.CENTER : r.CENTER + 3]
    table[:, r.SPHERE + 3] = around
    table[:, r.TEXTURE :] = [
        (s.texture, s.faces, s.cut_texture, s.scale) for s in shapes
    ] or np.zeros((0, 4))
    return table.astype(np.float32)


def _fill(table: np.ndarray, primitives: Sequence[Primitive]) -> None:
    if primitives:
        half = np.array([p.half for p in primitives])
        turn = np.array([p.turn for p in primitives]).reshape(-1, 3, 3)
        table[:, : r.MATRIX] = [(p.kind, p.extra) for p in primitives]
        table[:, r.MATRIX : r.CENTER] = (turn.transpose(0, 2, 1) / half[:, :, None]).reshape(-1, 9)
        table[:, r.CENTER : r.HALF] = [p.center for p in primitives]
        table[:, r.HALF : r.PRIMITIVE_FIELDS] = half

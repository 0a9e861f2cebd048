"""Kinds of scenes: rooms with openings, outdoor scenes, and objects on plain ground."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from random import Random

import numpy as np

from qgs_worlds.caster import tables as s
from qgs_worlds.caster.intervals import height_at
from qgs_worlds.caster.shapes import Point, Primitive, Shape, about_z, rod
from qgs_worlds.worlds.things import Thing, Things, any_angle, placed, spread

# half of a wall's thickness, metres
_WALL = 0.1
# half of the ground's width
_FAR = 600.0
# half of a terrain's width
_TERRAIN = 24.0

_box = partial(Primitive, s.BOX)


@dataclass
class Place:
    """Shapes of a scene, and possible positions and targets of its cameras, in metres.

    kind: "indoors", "outdoors" or "objects". fixed: number of shapes, at the start of `shapes`,
    that must not be removed to make room for cameras. low, high: corners of the box of allowed
    camera centres. eyes: smallest and largest usual height of a camera. targets: points to look at.
    distance: smallest and largest distance from a camera to its target. top: largest height of
    lamps.
    """

    kind: str
    shapes: list[Shape]
    fixed: int
    low: Point
    high: Point
    eyes: tuple[float, float]
    targets: list[Point]
    distance: tuple[float, float]
    top: float


def _toward(angle: float, away: float) -> tuple[float, float]:
    """Return x and y of the point at the distance `away` from the origin, in direction `angle`."""
    return away * math.cos(angle), away * math.sin(angle)


def _ground(things: Things, scale: float, height: float = 0.0) -> Shape:
    ground = things.skinned(_box((0.0, 0.0, height - 1.0), (_FAR, _FAR, 1.0)), scale)
    return ground._replace(faces=1)


def _middles(shapes: list[Shape]) -> list[Point]:
    return [shape.body.center for shape in shapes]


def _indoors(rng: Random, things: Things, count: int, maps: np.ndarray) -> Place:
    size = (rng.uniform(2.6, 7.5), rng.uniform(2.6, 7.5), rng.uniform(2.2, 3.8))
    plain = things.style.tilted == 0
    shapes = [_ground(things, spread(rng, 0.4, 1.5)), *_walls(rng, things, size, 0 if plain else 3)]
    # things that are visible through the openings
    for wall in [shape for shape in shapes if shape.cut]:
        toward = math.atan2(wall.body.center[1], wall.body.center[0])
        for _ in range(2):
            shapes += _far(rng, things, toward + rng.uniform(-0.6, 0.6))
    fixed = len(shapes)
    x = size[0] / 2
    y = size[1] / 2
    z = size[2]
    for _ in range(count):
        # things leave space for cameras
        extent = min(spread(rng, 0.15, 1.0), 0.3 * min(size))
        aside, behind = (rng.uniform(-half, half) * 0.85 for half in (x, y))
        thing = things.draw()
        lift = 0.0
        # things of varied scenes may float
        if rng.random() < 0.3 and not plain:
            lift = rng.uniform(0.2, max(z - 2.2 * extent, 0.3))
        shapes += placed(thing, (aside, behind, lift), any_angle(rng), extent)
    if not plain:
        for _ in range(rng.choice((0, 0, 1, 2))):
            shapes.append(_beam(rng, things, x, y, z))
    targets = _middles(shapes[fixed:])
    targets += [
        (rng.uniform(-x, x), rng.uniform(-y, y), rng.uniform(0.4, z - 0.4)) for _ in range(6)
    ]
    low = (0.3 - x, 0.3 - y, 0.35)
    high = (x - 0.3, y - 0.3, z - 0.35)
    eyes = (0.9, min(1.7, z - 0.4))
    return Place("indoors", shapes, fixed, low, high, eyes, targets, (0.6, 6.0), z)


def _beam(rng: Random, things: Things, x: float, y: float, z: float) -> Shape:
    """Return a thin random bar across a room, or a column from floor to ceiling.

    x, y: half the extent of the room. z: height of the room.
    """
    a = (rng.uniform(-x, x), rng.uniform(-y, y))
    b = (rng.uniform(-x, x), rng.uniform(-y, y))
    ends = rng.choice((((*a, 0.0), (*a, z)), ((-x, a[1], z * 0.9), (x, b[1], z * 0.9))))
    return things.skinned(rod(*ends, spread(rng, 0.006, 0.12), rng.random() < 0.5))


def _walls(rng: Random, things: Things, size: Point, most: int) -> Iterator[Shape]:
    """Yield four walls and a ceiling, with random windows or doors.

    size: extent of the room in metres. most: largest number of walls with an opening.
    """
    half_x = size[0] / 2
    half_y = size[1] / 2
    height = size[2]
    scale = spread(rng, 0.5, 2)
    common = things.texture()[0]
    open_sides = set(rng.sample(range(4), rng.randint(0, most)))
    for side in range(4):
        # walls are drawn at +x, then turned
        across, along = (half_x, half_y) if side % 2 == 0 else (half_y, half_x)
        body = _box((across + _WALL, 0.0, height / 2), (_WALL, along + 2 * _WALL, height / 2))
        hole = None
        if side in open_sides:
            wide = rng.uniform(0.25, 0.8) * along
            low = rng.choice((-0.1, rng.uniform(0.5, 1.1)))
            top = rng.uniform(max(low + 0.6, 1.7), height - 0.1)
            middle = rng.uniform(wide - along, along - wide) * 0.8
            hole = _box(
                (across + _WALL, middle, (low + top) / 2), (4 * _WALL, wide, (top - low) / 2)
            )
        texture = common if rng.random() < 0.6 else things.texture()[0]
        wall = [Shape(body, hole, texture, 1, common, scale)]
        if hole and rng.random() < 0.6:
            wall += _panes(rng, things, hole)
        yield from (part.moved(side * math.pi / 2) for part in wall)
    ceiling = _box((0.0, 0.0, height + _WALL), (half_x + 2 * _WALL, half_y + 2 * _WALL, _WALL))
    yield things.skinned(ceiling, scale)._replace(faces=1)


def _panes(rng: Random, things: Things, hole: Primitive) -> list[Shape]:
    """Return one or two bars (glazing bars) across `hole`, the opening of a wall."""
    (x, y, z) = hole.center
    (_, wide, high) = hole.half
    radius = rng.uniform(0.015, 0.05)
    texture = things.texture()[0]
    bars = [rod((x, y, z - high), (x, y, z + high), radius, True)]
    if rng.random() < 0.6:
        level = z + rng.uniform(-0.3, 0.4) * high
        bars.append(rod((x, y - wide, level), (x, y + wide, level), radius, True))
    return [Shape(bar, texture=texture, scale=0.3) for bar in bars]


def _outdoors(rng: Random, things: Things, count: int, maps: np.ndarray) -> Place:
    field = maps[0]
    amplitude = level = 0.0
    shapes = [_ground(things, spread(rng, 1, 4))]
    if rng.random() < 0.6:
        amplitude = spread(rng, 0.15, 1.5)
        index = rng.randrange(len(maps))
        shapes[0] = _ground(things, spread(rng, 1, 4), -0.7 * amplitude)
        half = (_TERRAIN, _TERRAIN, amplitude)
        body = Primitive(s.HEIGHT, (0.0, 0.0, 0.0), half, extra=float(index))
        shapes.append(things.skinned(body, spread(rng, 1, 4))._replace(faces=1))
        field = maps[index]
        # cameras stay on the middle half
        middle = len(field) // 4
        level = amplitude * float(field[middle:-middle, middle:-middle].max())
    fixed = len(shapes)
    # far things shape the horizon
    for _ in range(2 + count // 4):
        shapes += _far(rng, things, any_angle(rng))
    near: list[Shape] = []
    for _ in range(count):
        # denser in the middle, where cameras look
        away = 9 * rng.random() ** 0.7
        x, y = _toward(any_angle(rng), away)
        lift = 0.0 if rng.random() < 0.85 else rng.uniform(0.3, 3)
        ground = height_at(field, np.float32(x / _TERRAIN), np.float32(y / _TERRAIN))
        at = (x, y, lift + amplitude * ground)
        near += placed(things.draw(), at, any_angle(rng), spread(rng, 0.25, 2))
    shapes += near
    low = (-12.0, -12.0, level + 0.3)
    high = (12.0, 12.0, level + 7)
    eyes = (level + 0.6, level + 2.2)
    return Place("outdoors", shapes, fixed, low, high, eyes, _middles(near), (1.2, 11.0), level + 4)


def _far(rng: Random, things: Things, angle: float) -> Thing:
    """Return the shapes of a random distant hill, building or tree.

    The base of the object is below the lowest ground. angle: direction from the origin, in radians.
    """
    pick = rng.random()
    if pick < 0.3:
        away = rng.uniform(60, 220)
        size = rng.uniform(15, 60)
        x, y = _toward(angle, away)
        half = (size, size * rng.uniform(0.6, 1.8), size * rng.uniform(0.2, 0.6))
        body = Primitive(s.ELLIPSOID, (x, y, 0.0), half, about_z(any_angle(rng)))
        return [things.skinned(body, size / 2)]
    x, y = _toward(angle, spread(rng, 11, 70))
    if pick < 0.65:
        wide = rng.uniform(2, 7)
        deep = rng.uniform(2, 7)
        high = spread(rng, 2, 14)
        half = (wide, deep, high + 1)
        body = Primitive(s.BOX, (x, y, high - 1), half, about_z(any_angle(rng)))
        return [things.skinned(body, spread(rng, 2, 9))]
    high = rng.uniform(1, 3)
    crown = things.texture()[0]
    half = (0.12 * high, 0.12 * high, high + 1)
    trunk = Primitive(s.FRUSTUM, (x, y, high - 1), half, extra=0.6)
    tree = [things.skinned(trunk)]
    for _ in range(rng.randint(1, 4)):
        aside, behind = (rng.uniform(-0.5, 0.5) * high for _ in range(2))
        half = tuple(rng.uniform(0.35, 0.9) * high for _ in range(3))
        leaves = Primitive(s.ELLIPSOID, (x + aside, y + behind, rng.uniform(1.7, 2.6) * high), half)
        tree.append(Shape(leaves, texture=crown, scale=rng.uniform(0.5, 2)))
    return tree


def _objects(rng: Random, things: Things, count: int, maps: np.ndarray) -> Place:
    shapes = [_ground(things, spread(rng, 0.3, 1.5))]
    if rng.random() < 0.3:
        wall = _box((rng.uniform(1.5, 3), 0.0, 3.0), (0.1, 30.0, 4.0))
        wall = things.skinned(wall, spread(rng, 0.3, 1.5))
        shapes.append(wall.moved(any_angle(rng)))
    level = wide = 0.0
    if rng.random() < 0.4:
        level = rng.uniform(0.02, 0.8)
        wide = rng.uniform(0.5, 1.1)
        kind = rng.choice((s.BOX, s.FRUSTUM))
        table = Primitive(kind, (0.0, 0.0, level / 2), (wide, wide, level / 2), extra=1.0)
        shapes.append(things.skinned(table, 0.7))
    fixed = len(shapes)
    spot = (rng.gauss(0, 0.2), rng.gauss(0, 0.2))
    for number in range(count):
        # every second thing stands in a heap, where things occlude each other
        if number % 2:
            x = rng.gauss(0, 0.7)
            y = rng.gauss(0, 0.7)
        else:
            away = 0.5 * math.sqrt(rng.random())
            x, y = _toward(any_angle(rng), away)
            x += spot[0]
            y += spot[1]
        at = (x, y, level if math.hypot(x, y) < wide else 0.0)
        size = spread(rng, 0.1, 0.5)
        shapes += placed(things.draw(), at, any_angle(rng), size)
    low = (-3.5, -3.5, level + 0.2)
    high = (3.5, 3.5, level + 3)
    eyes = (level + 0.25, level + 1.6)
    targets = _middles(shapes[fixed:])
    return Place("objects", shapes, fixed, low, high, eyes, targets, (0.6, 2.5), level + 2.5)


PLACES = {"indoors": _indoors, "outdoors": _outdoors, "objects": _objects}
"""Functions that make a random scene of each kind, with a given number of objects."""
SHARES = (0.45, 0.3, 0.25)

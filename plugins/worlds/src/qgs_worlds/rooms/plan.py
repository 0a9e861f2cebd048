"""Random plan of a room: walls, window, furniture and lights."""

import math
from collections.abc import Iterator
from itertools import product
from random import Random

import numpy as np

from qgs_worlds.caster.interiors import blurred, darkened_floor
from qgs_worlds.caster.shapes import Point, Shape, about_z, rotated
from qgs_worlds.caster.tables import CYLINDER, LIGHT, Room, Size
from qgs_worlds.rooms.furniture import (
    AGAINST_WALLS,
    CENTRAL,
    LOOSE,
    Furniture,
    Piece,
    packed,
    solid,
)

# metres between a camera and the nearest shape
CLEARANCE = 0.4
# metres between pieces
_GAP = 0.05

# Rooms have no height fields.
NO_HEIGHTS = np.zeros((1, 2, 2), np.float32)

# Corners of a piece that fits at every place where another piece fits.
_SMALLEST = ((-0.15, -0.15, 0.0), (0.15, 0.15, 0.3))


def furnish(rng: Random, size: Size, eyes: np.ndarray) -> Room:
    """Return a random furnished room of `size` metres.

    eyes: camera centres (F, 3), from which furniture keeps a distance.
    """
    make = Furniture(rng)
    # in most rooms all four walls are of one kind
    wall = make.material("wall")
    walls = [wall] + [make.material("wall") if rng.random() < 0.4 else wall for _ in range(3)]
    surfaces = [*walls, make.material("floor"), make.material("pale")]
    furnisher = Furnisher(size, eyes)
    # the table comes first, because it needs the most room
    _centre(make, furnisher)
    for side in range(4):
        _against_wall(make, furnisher, side)
    for _ in range(3):
        name = rng.choice(LOOSE)
        x, y = (rng.uniform(-0.4, 0.4) * extent for extent in size[:2])
        furnisher.place(make.piece(name), (x, y, 0.0), rng.uniform(0, 2 * math.pi))
    window_side = rng.randrange(4)
    furnisher.shapes += _on_walls(make, size, window_side)
    furnisher.shapes += _fixed(make, size)
    shapes = packed(size, furnisher.shapes)
    lights = _lights(rng, size, window_side)
    # blurring twice is nearly a Gaussian; lamps are wide
    floor = 1 - blurred(blurred(darkened_floor(shapes, size, lights["place"][0])))
    return Room(shapes, NO_HEIGHTS, make.textures(surfaces), size, lights, floor)


class Furnisher:
    """Places furniture in a room, unless it collides with a camera or with an earlier piece."""

    def __init__(self, size: Size, eyes: np.ndarray) -> None:
        self.size = size
        self.eyes = eyes
        self.shapes: list[Shape] = []
        # lowest and highest corners of placed pieces
        self._taken = np.empty((0, 2, 3))

    def place(self, piece: Piece, to: Point, turn: float) -> bool:
        """Place `piece` at `to` on the floor, turned by `turn` radians, if it fits.

        Returns True if the piece was placed, False if it does not fit.
        """
        box = turned(*bounds(piece), to, turn)
        if not self.free(*box):
            return False
        self._taken = np.append(self._taken, [box], 0)
        self.shapes += [shape.moved(turn, to) for shape in piece]
        return True

    def free(self, low: np.ndarray, high: np.ndarray) -> bool:
        """Return True if a box is inside the room and clear of all placed pieces and cameras.

        low, high: its lowest and its highest corner.
        """
        half = np.array(self.size[:2]) / 2
        inside = (low[:2] >= -half) & (high[:2] <= half)
        beside = np.maximum(low - self._taken[:, 1], self._taken[:, 0] - high)[:, :2].max(1)
        away = np.maximum(low - self.eyes, self.eyes - high).clip(0)
        clear = np.linalg.norm(away, axis=1) > CLEARANCE
        return bool(inside.all() and (beside >= _GAP).all() and clear.all())


def bounds(shapes: list[Shape]) -> tuple[Point, Point]:
    """Return the lowest and the highest corner of the box around all of `shapes`."""
    center, half, turn = map(np.array, zip(*[shape.body[1:4] for shape in shapes], strict=True))
    reach = (abs(turn.reshape(-1, 3, 3)) @ half[..., None])[..., 0]
    low = (center - reach).min(0).tolist()
    high = (center + reach).max(0).tolist()
    return low, high


def turned(low: Point, high: Point, to: Point, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounding box of a box after a turn by `turn` radians about z and a move by `to`.

    low, high, and the result: lowest and highest corner of a box.
    """
    way = about_z(turn)
    corners = product(*zip(low, high, strict=True))
    moved = np.add([rotated(way, corner) for corner in corners], to)
    return moved.min(0), moved.max(0)


def _centre(make: Furniture, furnisher: Furnisher) -> None:
    rng = make.rng
    name = rng.choice(CENTRAL)
    turn = rng.randrange(4) * math.pi / 2 + rng.gauss(0, 0.12)
    piece = make.piece(name)
    # after a few failed tries the room stays without it
    for _ in range(4):
        x, y = (rng.uniform(-0.18, 0.18) * extent for extent in furnisher.size[:2])
        if furnisher.place(piece, (x, y, 0.0), turn):
            return


def _against_wall(make: Furniture, furnisher: Furnisher, side: int) -> None:
    """Place a row of random pieces with their backs to a wall.

    side: number of the wall; 0 to 3 are the walls at -x, -y, +x and +y.
    """
    rng = make.rng
    across = furnisher.size[side % 2]
    along = furnisher.size[1 - side % 2]
    turn = math.pi / 2 + side * math.pi / 2
    position = -along / 2 + rng.uniform(0.1, 0.6)
    while position < along / 2 - 0.4:
        # drawing a piece takes long, so first test if any piece would fit
        spot = turned(*_SMALLEST, _from_wall(side, across / 2 - 0.2, position + 0.2), turn)
        if furnisher.free(*spot):
            piece = make.piece(rng.choice(AGAINST_WALLS))
            low, high = bounds(piece)
            # the skirting board sticks out by 2 cm
            at = _from_wall(side, across / 2 - high[1] - 0.02, position - low[0])
            if furnisher.place(piece, at, turn):
                position += high[0] - low[0]
        position += rng.uniform(0.1, 0.5)


def _from_wall(side: int, away: float, along: float) -> Point:
    """Return a point on the floor that is given relative to the centre of the room and a wall.

    side: number of the wall, 0 to 3. away: metres from the centre of the room towards the wall.
    along: metres parallel to the wall, from the line that leads from the centre to the wall.
    """
    return rotated(about_z(math.pi + side * math.pi / 2), (away, -along, 0.0))


def _on_walls(make: Furniture, size: Size, window_side: int) -> Iterator[Shape]:
    """Yield the shapes of a window on wall `window_side` and of pictures on the other walls."""
    rng = make.rng
    for side in range(4):
        across = size[side % 2]
        along = size[1 - side % 2]
        turn = math.pi / 2 + side * math.pi / 2
        if side == window_side:
            window = make.piece("window")
            # a window is not in a corner
            hung = {rng.uniform(-0.15, 0.15) * along: window}
            # drawn even without a picture; otherwise the rooms of all seeds would change
            rng.random()
            rng.random()
        else:
            places = [along * (rng.uniform(-0.06, 0.06) + k) for k in (-0.27, 0.0, 0.27)]
            places = [place for place in places if rng.random() < 0.65]
            hung = {place: make.piece("picture") for place in places}
        for place, item in hung.items():
            at = _from_wall(side, across / 2, place)
            yield from (shape.moved(turn, at) for shape in item)


def _fixed(make: Furniture, size: Size) -> Iterator[Shape]:
    """Yield the shapes of skirting boards, of a ceiling lamp and, in most rooms, of a rug."""
    rng = make.rng
    board = make.material("pale")
    w, d, h = size
    for side in (-1, 1):
        yield solid((0, side * d / 2, 0), (w, 0.04, 0.09), board)
    for side in (-1, 1):
        yield solid((side * w / 2, 0, 0), (0.04, d, 0.09), board)
    lamp = (0, 0, h - 0.12)
    yield solid(lamp, (0.5, 0.5, 0.12), make.material("glow"), CYLINDER)
    if rng.random() < 0.75:
        wide = rng.uniform(0.35, 0.6) * w
        deep = rng.uniform(0.35, 0.6) * d
        rug = solid((0, 0, 0), (wide, deep, 0.012), make.material("rug"))
        x, y = [rng.uniform(-0.3, 0.3) for _ in range(2)]
        yield rug.moved(rng.gauss(0, 0.1), (x, y, 0.0))


def _lights(rng: Random, size: Size, window_side: int) -> np.ndarray:
    """Return a table of LIGHT with two rows: a warm lamp below the ceiling, a cool window."""
    x, y, _ = _from_wall(window_side, size[window_side % 2] / 2 - 0.1, 0.0)
    lights = np.zeros(2, LIGHT)
    lights["place"] = (0.0, 0.0, size[2] - 0.2), (x, y, 1.6)
    lamp = rng.uniform(0.55, 0.95)
    window = rng.uniform(0.45, 1.2)
    lights["color"] = (1.06 * lamp, lamp, 0.86 * lamp), (0.96 * window, window, 1.08 * window)
    return lights

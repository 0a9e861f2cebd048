"""Data source `rooms/procedural`: endless furnished rooms, ray-cast on demand.

The compiled kernels are imported when the first room is generated, because loading numba is slow.
"""

import math
from functools import cached_property
from random import Random
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from qgs.contracts.settings import ascending
from qgs_worlds.caster.lens import lens, look_along
from qgs_worlds.caster.shapes import about_z
from qgs_worlds.caster.tables import Room, Size
from qgs_worlds.drawn import DrawnConfig, DrawnScene, DrawnSource, ImageCache

# metres above the floor
EYE = (1.25, 1.65)
# least distance from a camera to a wall
WALL = 0.45
# metres from the first to the last camera
TRAVEL = (0.65, 1.2)


_Degrees = Annotated[float, Field(ge=5, le=150)]


class RoomsConfig(DrawnConfig):
    """Options of `rooms/procedural`."""

    fov: Annotated[tuple[_Degrees, _Degrees], AfterValidator(ascending)] = (60.0, 75.0)
    """Smallest and largest horizontal field of view, in degrees."""


class RoomScene(DrawnScene):
    """Furnished room, with its cameras on a path through the room.

    World frame: metres, z up, floor at z = 0.
    """

    def __init__(self, name: str, index: int, config: RoomsConfig, cache: ImageCache) -> None:
        super().__init__(name, index, config, cache)
        rng = np.random.default_rng(self.key)
        # drawn first, so that it does not depend on the number of draws for the path
        self._plan_seed = int(rng.integers(1 << 62))
        sizes = rng.uniform((4.2, 4.2, 2.45), (5.8, 5.8, 2.9))
        self.size: Size = tuple(map(float, sizes))  # type: ignore[assignment]
        self.c2w = camera_path(rng, self.size, config.views_per_scene)
        size = config.image_size
        self.lens = lens(rng.uniform(*config.fov), size[1], size)

    @cached_property
    def tables(self) -> Room:
        """The walls, furniture, textures and lights of the room, as tables for the ray caster."""
        from qgs_worlds.rooms.plan import furnish

        return furnish(Random(self._plan_seed), self.size, self.c2w[:, :3, 3])

    def cast(self, frames: list[int]) -> np.ndarray:
        """Return rendered images (len(frames), H, W, 3) uint8."""
        from qgs_worlds.caster.interiors import paint_room

        return self.rendered(frames, self._config.samples, paint_room, np.uint8)[1]


class RoomsSource(DrawnSource):
    """Source of random furnished rooms. Each room is determined by seed, split and index."""

    name = "procedural"
    Config = RoomsConfig
    scene = RoomScene


def camera_path(rng: np.random.Generator, size: Size, count: int) -> np.ndarray:
    """Return poses c2w (count, 4, 4) on a random path, with views across a room of `size` metres.

    Camera axes follow OpenCV. The path leads along a wall, in a random direction.
    """
    # drawn along one wall, then turned, so that all four walls are equally likely
    side = int(rng.integers(4))
    across = size[side % 2]
    along = size[1 - side % 2]
    travel = rng.uniform(*TRAVEL)
    back = rng.uniform(WALL + 0.1, 0.25 * across) - across / 2
    middle = rng.uniform(-1, 1) * max(along / 2 - WALL - travel / 2 - 0.1, 0.0)
    s = np.linspace(-0.5, 0.5, count)
    sway, lift = rng.uniform(-0.12, 0.12, 2)
    phase = rng.uniform(0, math.pi)
    eyes = np.stack(
        [
            # the last term keeps a swaying path from coming nearer to the wall
            back + sway * np.cos(3 * s + phase) + abs(sway),
            middle + travel * s,
            rng.uniform(*EYE) + lift * np.sin(3 * s + phase),
        ],
        -1,
    )
    drift = rng.uniform(-0.3, 0.5) * travel
    target = np.stack(
        [
            np.full(count, 0.25 * across),
            rng.uniform(-0.25, 0.25) * along - 0.35 * middle + drift * s,
            rng.uniform(0.7, 1.15) + 0.1 * np.sin(2 * s + phase),
        ],
        -1,
    )
    # walks go both ways
    if rng.random() < 0.5:
        eyes = eyes[::-1]
        target = target[::-1]
    turn = np.reshape(about_z(side * math.pi / 2), (3, 3))
    return look_along(eyes @ turn.T, (target - eyes) @ turn.T)

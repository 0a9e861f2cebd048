"""Data source `worlds/procedural`: endless abstract scenes, ray-cast on demand.

The compiled kernels are imported when the first scene is generated, because loading numba is slow.
"""

from collections.abc import Sequence
from functools import cached_property
from random import Random
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field, PositiveInt

from qgs.contracts import Ascending
from qgs_worlds.drawn import DrawnConfig, DrawnScene, DrawnSource, ImageCache
from qgs_worlds.rooms.source import RoomScene, RoomsConfig

if TYPE_CHECKING:
    from qgs_worlds.caster.tables import World
    from qgs_worlds.worlds.drawing import Drawn

Variety = Literal["plain", "varied"]


class WorldsConfig(DrawnConfig):
    """Options of `worlds/procedural`."""

    scenes: PositiveInt = 100_000
    """Number of scenes in the training split."""
    complexity: int = Field(default=32, ge=4)
    """Largest number of objects near the cameras. A scene has a random number, log-uniform from 4
    to `complexity`. An object consists of a few shapes."""
    cameras: Variety = "varied"
    """Camera paths. `plain`: level walks along a line, with fields of view of 60 to 75 degrees.
    `varied`: walks, orbits, turns on the spot, and scattered cameras that look at one point. Varied
    cameras have pitch, roll, tiny to wide baselines, and fields of view of 18 to 90 degrees. Fields
    of view are measured along the longer side of an image."""
    shapes: Variety = "varied"
    """Shapes of objects. `plain`: upright boxes, balls and cylinders in closed rooms. `varied`:
    randomly rotated composites of all kinds of primitives, with cuts, bars, wires and height
    fields; the scenes are rooms with openings, outdoor scenes, and objects on plain ground."""
    textures: Variety = "varied"
    """Textures. `plain`: uniform surfaces and simple patterns. `varied`: warped noise with a
    spectrum near 1/f, partly with a pattern on top."""
    light: Variety = "varied"
    """Light. `plain`: one lamp with soft shading and no cast shadows. `varied`: sun and lamps with
    shadows and highlights."""
    depth: Ascending | None = (1.2, 4.0)
    """Range [min, max] of the median depth of a scene, in metres. Each scene is scaled to a random
    median depth from this range, log-uniform. Null means that scenes are not scaled."""
    rooms: float = Field(default=0.0, ge=0, le=1)
    """Share of scenes, from 0 to 1, that are furnished rooms from the source `rooms/procedural`."""
    effects: bool = True
    """Vary exposure, white balance, tone curve, vignette, noise and JPEG quality from scene to
    scene. False means the same neutral camera for all scenes."""

    @cached_property
    def of_rooms(self) -> RoomsConfig:
        """Options of the source `rooms/procedural`, for the scenes that are furnished rooms."""
        alike = self.model_dump(include={"image_size", *DrawnConfig.model_fields})
        return RoomsConfig(**alike)


class WorldScene(DrawnScene):
    """Random scene of simple shapes, and its cameras. World frame: z up, in units of metres."""

    _config: WorldsConfig

    @cached_property
    def drawn(self) -> "Drawn":
        """Shapes, textures, lights and cameras of the scene, generated at first use."""
        from qgs_worlds.worlds.drawing import draw

        return draw(self.key, self._config)

    @property
    def tables(self) -> "World":
        """Shapes, textures and lights of the scene, as tables for the ray caster."""
        return self.drawn.world

    @property
    def scale(self) -> float:
        """Factor from lengths in the units of `tables` to metres."""
        return self.drawn.scale

    @property
    def c2w(self) -> np.ndarray:
        """Poses (F, 4, 4) of the F cameras, with OpenCV axes, in the units of `tables`."""
        return self.drawn.rig.c2w

    @property
    def lens(self) -> np.ndarray:
        """Intrinsics fx, fy, cx, cy in pixels, the same for all cameras of the scene."""
        return self.drawn.rig.lens(self._config.image_size)

    def cast(self, frames: list[int]) -> Sequence[np.ndarray]:
        """Return a rendered image (H, W, 3) uint8 for each of `frames`."""
        from qgs_worlds.caster.shading import paint

        _, light = self.rendered(frames, self._config.samples, paint)
        return [*map(self.drawn.effects.photo, light, frames)]


def world_or_room(name: str, index: int, config: WorldsConfig, cache: ImageCache) -> DrawnScene:
    """Return scene `index` of a split: a furnished room or an abstract scene.

    `config.rooms` is the probability of a furnished room.
    """
    split = name.partition("/")[0]
    # a separate generator, so that the share changes no scene
    if Random(f"{config.seed} {split} {index}").random() >= config.rooms:
        return WorldScene(name, index, config, cache)
    return RoomScene(name, index, config.of_rooms, cache)


class WorldsSource(DrawnSource):
    """Source of random abstract scenes. Seed, split and index determine a scene."""

    name = "procedural"
    Config = WorldsConfig
    scene = staticmethod(world_or_room)

"""`worlds/procedural`: endless scenes without meaning, ray-cast on demand.

Kernels are imported when the first scene is drawn: numba takes longer to load than a recipe does.
"""

import math
from collections.abc import Sequence
from functools import cached_property
from random import Random
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from pydantic import Field, field_validator

from qgs.contracts import Split
from qgs_worlds.drawn import DrawnConfig, DrawnScene, DrawnSource, ImageCache
from qgs_worlds.rooms.source import RoomScene, RoomsConfig

if TYPE_CHECKING:
    from qgs_worlds.caster.tables import World
    from qgs_worlds.worlds.drawing import Drawn

Variety: TypeAlias = Literal["plain", "varied"]


class WorldsConfig(DrawnConfig):
    """Options of `worlds/procedural`."""

    scenes: int = Field(default=100_000, ge=1)
    """Scenes of the training split."""
    complexity: int = Field(default=32, ge=4)
    """The most things near the cameras, of a few shapes each; how many is drawn log-uniformly."""
    cameras: Variety = "varied"
    """Plain: a walk along a line, level, with a field of view of 60 to 75 degrees. Varied: walks,
    orbits, looks round and sets that look at one point, over baselines from tiny to wide, with
    pitch and roll and 18 to 90 degrees. Fields of view are across an image's longer side."""
    shapes: Variety = "varied"
    """Plain: upright boxes, balls and cylinders in closed rooms. Varied: composites of all
    primitives turned freely, with cuts, bars, wires and height fields, in rooms with openings, in
    the open, and on plain ground."""
    textures: Variety = "varied"
    """Plain: even surfaces and simple patterns. Varied: noise near 1/f, warped, and patterns."""
    light: Variety = "varied"
    """Plain: one lamp and soft shading. Varied: sun and lamps with shadows, highlights, fog."""
    depth: tuple[float, float] | None = (1.2, 4.0)
    """Least and largest median depth of what cameras see, metres; each scene is scaled to a depth
    drawn from it log-uniformly. null: scenes are as large as they are drawn."""
    rooms: float = Field(default=0.0, ge=0, le=1)
    """Share of scenes that are those of `rooms/procedural` instead, with the same numbers."""
    effects: bool = True
    """Whether cameras differ in exposure, white balance, tone, vignette, noise and JPEG quality."""

    @field_validator("depth")
    @classmethod
    def _depth_is_a_range(cls, depth: tuple[float, float] | None) -> tuple[float, float] | None:
        if depth is not None and not 0 < depth[0] <= depth[1] < math.inf:
            raise ValueError(
                f"depth must be [min, max] metres with 0 < min <= max, got {list(depth)}"
            )
        return depth

    @cached_property
    def of_rooms(self) -> RoomsConfig:
        """Options of the rooms among the scenes."""
        alike = self.model_dump(include={"image_size", *DrawnConfig.model_fields})
        return RoomsConfig(**alike)


class WorldScene(DrawnScene):
    """One scene and its cameras. World: metres, scaled by `drawn.scale`; z up."""

    _config: WorldsConfig

    @cached_property
    def drawn(self) -> "Drawn":
        """What is there, and how it is seen."""
        from qgs_worlds.worlds.drawing import draw

        return draw(self.key, self._config)

    @property
    def tables(self) -> "World":
        """See `DrawnScene`."""
        return self.drawn.world

    @property
    def scale(self) -> float:
        """See `DrawnScene`."""
        return self.drawn.scale

    @property
    def c2w(self) -> np.ndarray:
        """See `DrawnScene`."""
        return self.drawn.rig.c2w

    @property
    def lens(self) -> np.ndarray:
        """See `DrawnScene`."""
        return self.drawn.rig.lens(self._config.image_size)

    def cast(self, frames: list[int]) -> Sequence[np.ndarray]:
        """See `DrawnScene`."""
        return self.drawn.photos(frames, self._config.image_size, self._config.samples)


def world_or_room(
    name: str, index: int, config: WorldsConfig, split: Split, cache: ImageCache
) -> DrawnScene:
    """Scene `index` of a split: a world, or a room by the share of `rooms`."""
    # a generator of its own, so that the share changes no scene
    if Random(f"{config.seed} {split} {index}").random() >= config.rooms:
        return WorldScene(name, index, config, split, cache)
    return RoomScene(name, index, config.of_rooms, split, cache)


class WorldsSource(DrawnSource):
    """Endless procedural scenes; scene i of a split is a function of (seed, split, i) alone."""

    name = "procedural"
    Config = WorldsConfig
    scene = staticmethod(world_or_room)

"""Data source `worlds/procedural`: endless abstract scenes, ray-cast on demand.

Kernels are imported when the first scene is drawn, since numba takes longer to load than a recipe.
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
    """Number of scenes in the training split."""
    complexity: int = Field(default=32, ge=4)
    """Largest number of things near the cameras, each of a few shapes. The number is drawn
    log-uniformly."""
    cameras: Variety = "varied"
    """Camera paths. Plain: level walks along a line, with fields of view of 60 to 75 degrees.
    Varied: walks, orbits, looks around and sets that look at one point, with tiny to wide
    baselines, pitch, roll and 18 to 90 degrees. Fields of view are across the longer side of an
    image."""
    shapes: Variety = "varied"
    """Shapes of things. Plain: upright boxes, balls and cylinders in closed rooms. Varied: freely
    turned composites of all primitives, with cuts, bars, wires and height fields, in rooms with
    openings, outdoors and on plain ground."""
    textures: Variety = "varied"
    """Textures. Plain: uniform surfaces and simple patterns. Varied: warped noise near 1/f, and
    patterns."""
    light: Variety = "varied"
    """Light. Plain: one lamp and soft shading. Varied: sun and lamps with shadows, highlights and
    fog."""
    depth: tuple[float, float] | None = (1.2, 4.0)
    """Smallest and largest median depth in the views, in metres. Each scene is scaled to a depth
    drawn log-uniformly from this range. Null: scenes are not scaled."""
    rooms: float = Field(default=0.0, ge=0, le=1)
    """Share of scenes, from 0 to 1, to take from `rooms/procedural` at the same index."""
    effects: bool = True
    """Vary exposure, white balance, tone, vignette, noise and JPEG quality between cameras."""

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
        """Options of the scenes that are rooms."""
        alike = self.model_dump(include={"image_size", *DrawnConfig.model_fields})
        return RoomsConfig(**alike)


class WorldScene(DrawnScene):
    """Scene with its cameras. World: metres, scaled by `drawn.scale`; z up."""

    _config: WorldsConfig

    @cached_property
    def drawn(self) -> "Drawn":
        """Content, light and cameras of the scene."""
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
    """Return scene `index` of a split: a world, or a room for a share `rooms` of the scenes."""
    # a separate generator, so that the share changes no scene
    if Random(f"{config.seed} {split} {index}").random() >= config.rooms:
        return WorldScene(name, index, config, split, cache)
    return RoomScene(name, index, config.of_rooms, split, cache)


class WorldsSource(DrawnSource):
    """Source of endless procedural scenes; scene i of a split depends only on (seed, split, i)."""

    name = "procedural"
    Config = WorldsConfig
    scene = staticmethod(world_or_room)

"""`rooms/procedural`: endless furnished rooms, ray-cast on demand.

Kernels are imported when the first room is drawn: numba takes longer to load than a recipe does.
"""

from collections.abc import Sequence
from functools import cached_property
from random import Random
from typing import TYPE_CHECKING

import numpy as np
import torch
from pydantic import model_validator
from torch import Tensor

from qgs.contracts import Split
from qgs.types import Cameras
from qgs_worlds.caster.lens import lens
from qgs_worlds.drawn import DrawnConfig, DrawnScene, DrawnSource, ImageCache
from qgs_worlds.rooms.path import camera_path

if TYPE_CHECKING:
    from qgs_worlds.caster.tables import Room


class RoomsConfig(DrawnConfig):
    """Options of `rooms/procedural`."""

    fov: tuple[float, float] = (60.0, 75.0)
    """Least and largest horizontal field of view, degrees."""

    @model_validator(mode="after")
    def _fov_is_a_range(self) -> "RoomsConfig":
        low, high = self.fov
        if not 5 <= low <= high <= 150:
            raise ValueError(
                f"fov must be [min, max] degrees with 5 <= min <= max <= 150, got [{low}, {high}]"
            )
        return self


class RoomScene(DrawnScene):
    """One room and the cameras on its path. World: metres, z up, the floor at 0."""

    def __init__(
        self, name: str, index: int, config: RoomsConfig, split: Split, cache: ImageCache
    ) -> None:
        super().__init__(name, index, config, split, cache)
        rng = np.random.default_rng(self.key)
        # drawn first, so that it does not depend on how many numbers the path takes
        self._plan_seed = int(rng.integers(1 << 62))
        sizes = rng.uniform((4.2, 4.2, 2.45), (5.8, 5.8, 2.9))
        self.size: tuple[float, float, float] = tuple(map(float, sizes))  # type: ignore[assignment]
        self._c2w = camera_path(rng, self.size, config.views_per_scene)
        self._intrinsics = lens(float(rng.uniform(*config.fov)), config.image_size)

    @cached_property
    def cameras(self) -> Cameras:
        """See `Scene`."""
        intrinsics = torch.from_numpy(self._intrinsics).float().expand(len(self), 4)
        return Cameras(torch.from_numpy(self._c2w).float(), intrinsics, self._config.image_size)

    @cached_property
    def room(self) -> "Room":
        """The furnished room."""
        from qgs_worlds.rooms.plan import furnish

        return furnish(Random(self._plan_seed), self.size, self._c2w[:, :3, 3])

    def cast(self, frames: list[int]) -> np.ndarray:
        """See `DrawnScene`."""
        from qgs_worlds.caster.casting import cast
        from qgs_worlds.caster.interiors import paint_room

        config = self._config
        images = np.empty((len(frames), *config.image_size, 3), np.uint8)
        cast(self.room, paint_room, images, self._c2w[frames], self._intrinsics, config.samples)
        return images

    def depths(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`: z along the ray through the pixel's centre."""
        from qgs_worlds.caster.casting import cast_depths

        cameras = (self._c2w[list(frames)], self._intrinsics)
        return torch.from_numpy(cast_depths(self.room, *cameras, self._config.image_size))[:, None]


class RoomsSource(DrawnSource):
    """Endless procedural rooms; room i of a split is a function of (seed, split, i) alone."""

    name = "procedural"
    Config = RoomsConfig
    scene = RoomScene

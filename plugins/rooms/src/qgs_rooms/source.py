"""`rooms/procedural`: endless furnished rooms, ray-cast on demand.

Kernels are imported when the first room is drawn: numba takes longer to load than a recipe does.
"""

import math
from collections.abc import Sequence
from functools import cached_property, partial
from random import Random
from typing import ClassVar

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from qgs.contracts import Scene, SceneSource, Split
from qgs.data.scenes import LazyScenes, LazySource
from qgs.types import Cameras
from qgs_rooms.path import camera_path
from qgs_rooms.plan import furnish
from qgs_rooms.shapes import Room

_SHADOW_CELLS = 80

ImageCache = dict[tuple[str, int], np.ndarray]
"""Images (H, W, 3) uint8 by scene and frame; once it is full, what it holds stays."""


class RoomsConfig(SceneSource.Config):
    """Options of `rooms/procedural`."""

    scenes: int = Field(default=2000, ge=1)
    """Rooms of the training split."""
    test_scenes: int = Field(default=32, ge=1)
    """Rooms of the test split; none of them is in the training split."""
    views_per_scene: int = Field(default=8, ge=2)
    """Cameras on the path through each room."""
    samples: int = Field(default=2, ge=1, le=8)
    """Rays per pixel along each axis."""
    fov: tuple[float, float] = (60.0, 75.0)
    """Least and largest horizontal field of view, degrees."""
    seed: int = Field(default=0, ge=0)
    """All rooms follow from it."""
    cache_mb: int = Field(default=512, ge=0)
    """Megabytes of images kept in memory; 0 keeps none."""

    @model_validator(mode="after")
    def _fov_is_a_range(self) -> "RoomsConfig":
        low, high = self.fov
        if not 5 <= low <= high <= 150:
            raise ValueError(
                f"fov must be [min, max] degrees with 5 <= min <= max <= 150, got [{low}, {high}]"
            )
        return self


class RoomScene(Scene):
    """One room and the cameras on its path. World: metres, z up, the floor at 0."""

    def __init__(
        self, name: str, index: int, config: RoomsConfig, split: Split, cache: ImageCache
    ) -> None:
        self.name = name
        self._config, self._cache = config, cache
        rng = np.random.default_rng([config.seed, 0 if split == "train" else 1, index])
        self._plan_seed = int(rng.integers(1 << 62))
        sizes = rng.uniform((4.2, 4.2, 2.45), (5.8, 5.8, 2.9))
        self.size: tuple[float, float, float] = tuple(map(float, sizes))  # type: ignore[assignment]
        self._c2w = camera_path(rng, self.size, config.views_per_scene)
        height, width = config.image_size
        focal = width / 2 / math.tan(math.radians(float(rng.uniform(*config.fov))) / 2)
        self._intrinsics = np.array([focal, focal, width / 2, height / 2])

    def __len__(self) -> int:
        return self._config.views_per_scene

    @cached_property
    def cameras(self) -> Cameras:
        """See `Scene`."""
        intrinsics = torch.from_numpy(self._intrinsics).float().expand(len(self), 4)
        return Cameras(torch.from_numpy(self._c2w).float(), intrinsics, self._config.image_size)

    @cached_property
    def room(self) -> Room:
        """The furnished room."""
        return furnish(Random(self._plan_seed), self.size, self._c2w[:, :3, 3])

    @cached_property
    def _floor(self) -> np.ndarray:
        from qgs_rooms.shading import floor_shadows

        return floor_shadows(self.room.shapes, self.size, self.room.lights[0], _SHADOW_CELLS)

    def images(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`."""
        config, cache = self._config, self._cache
        images = {frame: cache[self.name, frame] for frame in frames if (self.name, frame) in cache}
        if missing := [frame for frame in dict.fromkeys(frames) if frame not in images]:
            from qgs_rooms.casting import cast_images

            size, cameras = config.image_size, (self._c2w[missing], self._intrinsics)
            cast = cast_images(self.room, self._floor, *cameras, size, config.samples)
            images.update(zip(missing, cast, strict=True))
            fitting = config.cache_mb * 2**20 // cast[0].nbytes - len(cache)
            cache.update(
                {(self.name, frame): images[frame] for frame in missing[: max(fitting, 0)]}
            )
        out = np.empty((len(frames), 3, *config.image_size), np.float32)
        for place, frame in enumerate(frames):
            np.multiply(images[frame].transpose(2, 0, 1), np.float32(1 / 255), out=out[place])
        return torch.from_numpy(out)

    def depths(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`: z along the ray through the pixel's centre."""
        from qgs_rooms.casting import cast_depths

        cameras = (self._c2w[list(frames)], self._intrinsics)
        return torch.from_numpy(cast_depths(self.room, *cameras, self._config.image_size))[:, None]


class RoomsSource(LazySource):
    """Endless procedural rooms; room i of a split is a function of (seed, split, i) alone."""

    name = "procedural"
    Config = RoomsConfig
    not_in_protocol: ClassVar[frozenset[str]] = SceneSource.not_in_protocol | {"cache_mb"}
    split_options: ClassVar[frozenset[str]] = frozenset({"scenes", "test_scenes"})

    def __init__(self, config: RoomsConfig) -> None:
        super().__init__(config)
        cache: ImageCache = {}
        counts: dict[Split, int] = {"train": config.scenes, "test": config.test_scenes}
        self.splits = {
            split: LazyScenes(
                {f"{split}/{index:06d}": index for index in range(count)},
                partial(RoomScene, config=config, split=split, cache=cache),
            )
            for split, count in counts.items()
        }

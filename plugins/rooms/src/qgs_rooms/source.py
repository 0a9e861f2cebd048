"""`rooms/procedural`: endless furnished rooms, ray-cast on demand."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from importlib.util import find_spec
from typing import ClassVar

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from qgs.contracts import Scene, SceneSource, Split
from qgs.contracts.component import MissingExtraError
from qgs.data.scenes import LazyScenes
from qgs.types import Cameras
from qgs_rooms.draws import Draws
from qgs_rooms.path import camera_path
from qgs_rooms.shapes import Room

_BAND = 64  # rows of an image that one thread casts at a time
_SHADOW_CELLS = 80


class RoomsConfig(SceneSource.Config):
    """Options of `rooms/procedural`.

    scenes, test_scenes: rooms of the two splits; no room is in both. views_per_scene: cameras on
    each path. samples: rays per pixel along each axis. fov: least and largest horizontal field of
    view, degrees. seed: all rooms follow from it. cache_mb: megabytes of images kept in memory,
    0 for none.
    """

    unhashed_options: ClassVar[frozenset[str]] = SceneSource.Config.unhashed_options | {"cache_mb"}
    split_options: ClassVar[frozenset[str]] = frozenset({"scenes", "test_scenes"})

    scenes: int = Field(default=2000, ge=1)
    test_scenes: int = Field(default=32, ge=1)
    views_per_scene: int = Field(default=8, ge=2)
    samples: int = Field(default=2, ge=1, le=8)
    fov: tuple[float, float] = (60.0, 75.0)
    seed: int = Field(default=0, ge=0)
    cache_mb: int = Field(default=512, ge=0)

    @model_validator(mode="after")
    def _fov_is_a_range(self) -> RoomsConfig:
        low, high = self.fov
        if not 5 <= low <= high <= 150:
            raise ValueError(
                f"fov must be [min, max] degrees with 5 <= min <= max <= 150, got [{low}, {high}]"
            )
        return self


class ImageCache:
    """Decoded images (H, W, 3) uint8 by key, until the budget in bytes is spent."""

    def __init__(self, budget: int) -> None:
        self._left = budget
        self._images: dict[tuple[str, int], np.ndarray] = {}

    def get(self, key: tuple[str, int]) -> np.ndarray | None:
        """The image of `key`, None when it was not kept."""
        return self._images.get(key)

    def put(self, key: tuple[str, int], image: np.ndarray) -> None:
        """Keep `image` if there is room for it."""
        if key not in self._images and image.nbytes <= self._left:
            self._left -= image.nbytes
            self._images[key] = image


class RoomScene(Scene):
    """One room and the cameras on its path. World: metres, z up, the floor at 0."""

    def __init__(self, config: RoomsConfig, split: Split, index: int, cache: ImageCache) -> None:
        self.name = f"{split}/{index:06d}"
        self._config, self._cache = config, cache
        rng = np.random.default_rng([config.seed, 0 if split == "train" else 1, index])
        self._layout_seed, camera_rng = int(rng.integers(1 << 62)), rng
        sizes = camera_rng.uniform((4.2, 4.2, 2.45), (5.8, 5.8, 2.9))
        self.size: tuple[float, float, float] = tuple(map(float, sizes))  # type: ignore[assignment]
        self._c2w = camera_path(camera_rng, self.size, config.views_per_scene)
        height, width = config.image_size
        fov = math.radians(float(camera_rng.uniform(*config.fov)))
        focal = width / 2 / math.tan(fov / 2)
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
        from qgs_rooms.plan import furnish

        return furnish(Draws(self._layout_seed), self.size, self._c2w[:, :3, 3])

    @cached_property
    def _floor(self) -> np.ndarray:
        from qgs_rooms.shading import floor_shadows

        return floor_shadows(self.room.shapes, self.size, self.room.lights[0], _SHADOW_CELLS)

    def images(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`."""
        known = {frame: self._cache.get((self.name, frame)) for frame in frames}
        missing = [frame for frame, image in known.items() if image is None]
        for frame, image in zip(missing, self._cast_colors(missing), strict=True):
            self._cache.put((self.name, frame), image)
            known[frame] = image
        out = np.empty((len(frames), 3, *self._config.image_size), np.float32)
        for place, frame in enumerate(frames):
            image = known[frame]
            assert image is not None
            np.multiply(image.transpose(2, 0, 1), np.float32(1 / 255), out=out[place])
        return torch.from_numpy(out)

    def depths(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`: z along the ray through the pixel's centre."""
        from qgs_rooms.casting import cast_depths

        room, out = self.room, np.empty((len(frames), *self._config.image_size), np.float32)
        self._cast(
            lambda i, rows: cast_depths(out[i], rows, room, self._c2w[frames[i]], self._intrinsics),
            len(frames),
        )
        return torch.from_numpy(out)[:, None]

    def _cast_colors(self, frames: Sequence[int]) -> np.ndarray:
        from qgs_rooms.casting import cast_colors

        out = np.empty((len(frames), *self._config.image_size, 3), np.uint8)
        if not frames:
            return out
        room, floor, samples = self.room, self._floor, self._config.samples
        self._cast(
            lambda i, rows: cast_colors(
                out[i], rows, samples, room, floor, self._c2w[frames[i]], self._intrinsics
            ),
            len(frames),
        )
        return out

    def _cast(self, cast: Callable[[int, tuple[int, int]], None], frames: int) -> None:
        """Call `cast(i, rows)` for bands of rows of every frame, on torch's number of threads."""
        height = self._config.image_size[0]
        bands = [(top, min(top + _BAND, height)) for top in range(0, height, _BAND)]
        work = [(i, rows) for i in range(frames) for rows in bands]
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            list(pool.map(lambda unit: cast(*unit), work))


class RoomScenes(LazyScenes):
    """The rooms of a split, made when they are asked for."""

    def __init__(self, config: RoomsConfig, split: Split, count: int, cache: ImageCache) -> None:
        self._config, self._count, self._cache = config, count, cache
        self._split: Split = split

    def __len__(self) -> int:
        return self._count

    def scene(self, place: int) -> RoomScene:
        """See `LazyScenes`."""
        return RoomScene(self._config, self._split, place, self._cache)


class RoomsSource(SceneSource):
    """Endless procedural rooms; room i of a split is a function of (seed, split, i) alone."""

    name = "procedural"
    Config = RoomsConfig

    def __init__(self, config: RoomsConfig) -> None:
        super().__init__(config)
        if find_spec("numba") is None:
            raise MissingExtraError(
                "the data source rooms/procedural needs numba, which is not installed: run "
                '`pip install "query-gaussians[cpu]"`'
            )
        cache = ImageCache(config.cache_mb * 2**20)
        train = RoomScenes(config, "train", config.scenes, cache)
        test = RoomScenes(config, "test", config.test_scenes, cache)
        self._scenes: dict[Split, RoomScenes] = {"train": train, "test": test}

    def scenes(self, split: Split) -> Sequence[Scene]:
        """See `SceneSource`."""
        return self._scenes[split]

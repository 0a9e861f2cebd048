"""Base classes of procedural scenes, whose images are rendered on demand and cached."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import Field, NonNegativeInt, PositiveInt
from torch import Tensor

from qgs.contracts import Scene, SceneSource, Split
from qgs.data.scenes import LazyScenes, LazySource
from qgs.types import Cameras
from qgs_worlds.caster.tables import Room, World

ImageCache = dict[tuple[str, int], np.ndarray]
"""Images (H, W, 3) uint8 by scene name and frame. A full cache takes no new images."""


class DrawnConfig(SceneSource.Config):
    """Options that all sources of procedural scenes have."""

    scenes: PositiveInt = 2000
    """Number of scenes in the training split."""
    test_scenes: PositiveInt = 32
    """Number of scenes in the test split. Test scenes differ from training scenes."""
    views_per_scene: int = Field(default=8, ge=2)
    """Number of cameras in each scene."""
    samples: int = Field(default=2, ge=1, le=8)
    """Number of rays per pixel along each axis; 2 means 2 x 2 rays per pixel."""
    seed: NonNegativeInt = 0
    """Random seed, from 0 on, which determines all scenes."""
    cache_mb: NonNegativeInt = 512
    """Memory in MiB for a cache of rendered images. 0 means that no images are kept."""


class DrawnScene(Scene):
    """Procedural scene with F = `views_per_scene` cameras, determined by (seed, split, index).

    name: SPLIT/INDEX.
    c2w: poses (F, 4, 4) with OpenCV axes, in the units of `tables`. lens: fx, fy, cx, cy in pixels.
    scale: factor from lengths in the units of `tables` to metres.
    """

    c2w: np.ndarray
    lens: np.ndarray
    scale = 1.0

    def __init__(self, name: str, index: int, config: DrawnConfig, cache: ImageCache) -> None:
        self.name = name
        self._config = config
        self._cache = cache
        # a list, because numpy's generators take a list as seed
        self.key = [config.seed, 0 if name.startswith("train") else 1, index]

    def __len__(self) -> int:
        return self._config.views_per_scene

    @property
    @abstractmethod
    def tables(self) -> World | Room:
        """The shapes, textures and lights of the scene, as tables for the ray caster."""

    @cached_property
    def cameras(self) -> Cameras:
        """Cameras (F,) of all frames, with lengths in metres."""
        intrinsics = torch.from_numpy(self.lens).float().expand(len(self), 4)
        # float() copies float64, so the poses of the ray caster keep their units
        c2w = torch.from_numpy(self.c2w).float()
        c2w[:, :3, 3] *= self.scale
        return Cameras(c2w, intrinsics, self._config.image_size)

    def depths(self, frames: Sequence[int]) -> Tensor:
        """Return depths (z) at the pixel centres of F frames, (F, 1, H, W) in metres.

        A depth of 0 marks the sky, which has no depth.
        """
        depths, _ = self.rendered(frames)
        return torch.from_numpy(np.nan_to_num(depths, posinf=0))[:, None] * self.scale

    def rendered(self, frames: Sequence[int], *how: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return depths and images of F frames, as `cast` does.

        how: arguments of `cast` from `samples` on.
        """
        from qgs_worlds.caster.casting import cast

        return cast(self.tables, self.c2w[list(frames)], self.lens, self._config.image_size, *how)

    @abstractmethod
    def cast(self, frames: list[int]) -> Sequence[np.ndarray]:
        """Return a rendered image (H, W, 3) uint8 for each of `frames`."""

    def images(self, frames: Sequence[int]) -> Tensor:
        """Return images (F, 3, H, W) of F frames, float32 in [0, 1], from the cache or rendered."""
        config = self._config
        cache = self._cache
        images = {frame: cache[self.name, frame] for frame in frames if (self.name, frame) in cache}
        if missing := [frame for frame in dict.fromkeys(frames) if frame not in images]:
            cast = self.cast(missing)
            images.update(zip(missing, cast, strict=True))
            # keep the first scenes: dropping the oldest would keep none over an epoch
            fitting = config.cache_mb * 2**20 // cast[0].nbytes - len(cache)
            cache.update(
                {(self.name, frame): images[frame] for frame in missing[: max(fitting, 0)]}
            )
        found = torch.from_numpy(np.stack([images[frame] for frame in frames]))
        return found.permute(0, 3, 1, 2).contiguous() * (1 / 255)


class DrawnSource(LazySource):
    """Source of procedural scenes. Each scene is determined by seed, split and index."""

    Config = DrawnConfig
    scene: ClassVar[Callable[..., DrawnScene]]
    """Function that makes a scene from its name, index, config and cache."""
    not_in_protocol = SceneSource.not_in_protocol | {"cache_mb"}
    split_options = frozenset({"scenes", "test_scenes"})

    def __init__(self, config: DrawnConfig) -> None:
        super().__init__(config)
        cache: ImageCache = {}
        counts: dict[Split, int] = {"train": config.scenes, "test": config.test_scenes}
        scene = partial(self.scene, config=config, cache=cache)
        self.splits = {
            split: LazyScenes({f"{split}/{index:06d}": index for index in range(count)}, scene)
            for split, count in counts.items()
        }

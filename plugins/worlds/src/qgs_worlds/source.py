"""`worlds/procedural`: endless scenes without meaning, ray-cast on demand.

Kernels are imported when the first scene is drawn: numba takes longer to load than a recipe does.
"""

import math
from collections.abc import Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias

import numpy as np
import torch
from pydantic import Field
from qgs_rooms.source import ImageCache
from torch import Tensor

from qgs.contracts import Scene, SceneSource, Split
from qgs.data.scenes import LazyScenes, LazySource
from qgs.types import Cameras

if TYPE_CHECKING:
    from qgs_worlds.drawing import Drawn

Variety: TypeAlias = Literal["plain", "varied"]


class WorldsConfig(SceneSource.Config):
    """Options of `worlds/procedural`."""

    scenes: int = Field(default=100_000, ge=1)
    """Scenes of the training split."""
    test_scenes: int = Field(default=32, ge=1)
    """Scenes of the test split; none of them is in the training split."""
    views_per_scene: int = Field(default=8, ge=2)
    """Cameras in each scene."""
    complexity: int = Field(default=32, ge=4)
    """The most things in a scene, which have a few shapes each; how many is drawn log-uniformly."""
    cameras: Variety = "varied"
    """Plain: a walk along a line, level, with a field of view of 60 to 75 degrees. Varied: walks,
    orbits, looks round and sets that look at one point, over baselines from tiny to wide, with
    pitch and roll and 40 to 90 degrees."""
    shapes: Variety = "varied"
    """Plain: upright boxes, balls and cylinders in closed rooms. Varied: composites of all
    primitives turned freely, with cuts, bars, wires and height fields, in rooms with openings, in
    the open, and on plain ground."""
    textures: Variety = "varied"
    """Plain: even surfaces and simple patterns. Varied: noise near 1/f, warped, and patterns."""
    light: Variety = "varied"
    """Plain: one lamp and soft shading. Varied: sun and lamps with shadows, highlights, fog."""
    effects: bool = True
    """Whether cameras differ in exposure, white balance, tone, vignette, noise and JPEG quality."""
    samples: int = Field(default=2, ge=1, le=8)
    """Rays per pixel along each axis."""
    seed: int = Field(default=0, ge=0)
    """All scenes follow from it."""
    cache_mb: int = Field(default=512, ge=0)
    """Megabytes of images kept in memory; 0 keeps none."""


class WorldScene(Scene):
    """One scene and its cameras. World: metres, z up."""

    def __init__(
        self, name: str, index: int, config: WorldsConfig, split: Split, cache: ImageCache
    ) -> None:
        self.name = name
        self._config, self._cache = config, cache
        self._key = [config.seed, 0 if split == "train" else 1, index]

    def __len__(self) -> int:
        return self._config.views_per_scene

    @cached_property
    def drawn(self) -> "Drawn":
        """What is there, and how it is seen."""
        from qgs_worlds.drawing import draw

        return draw(self._key, self._config)

    @cached_property
    def _intrinsics(self) -> np.ndarray:
        return lens(self.drawn.rig.fov, self._config.image_size)

    @cached_property
    def cameras(self) -> Cameras:
        """See `Scene`."""
        intrinsics = torch.from_numpy(self._intrinsics).float().expand(len(self), 4)
        c2w = torch.from_numpy(self.drawn.rig.c2w).float()
        return Cameras(c2w, intrinsics, self._config.image_size)

    def images(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`."""
        config, cache = self._config, self._cache
        images = {frame: cache[self.name, frame] for frame in frames if (self.name, frame) in cache}
        if missing := [frame for frame in dict.fromkeys(frames) if frame not in images]:
            photos = self.drawn.photos(missing, config.image_size, config.samples)
            images.update(zip(missing, photos, strict=True))
            fitting = config.cache_mb * 2**20 // photos[0].nbytes - len(cache)
            cache.update(
                {(self.name, frame): images[frame] for frame in missing[: max(fitting, 0)]}
            )
        out = np.empty((len(frames), 3, *config.image_size), np.float32)
        for place, frame in enumerate(frames):
            np.multiply(images[frame].transpose(2, 0, 1), np.float32(1 / 255), out=out[place])
        return torch.from_numpy(out)

    def depths(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`: z along the ray through the pixel's centre; the sky is unknown."""
        depths = self.drawn.depths(frames, self._config.image_size)
        return torch.from_numpy(depths)[:, None]


def lens(fov: float, size: tuple[int, int]) -> np.ndarray:
    """fx, fy, cx, cy in pixels of a horizontal field of view in degrees, for (H, W)."""
    focal = size[1] / 2 / math.tan(math.radians(fov) / 2)
    return np.array([focal, focal, size[1] / 2, size[0] / 2])


class WorldsSource(LazySource):
    """Endless procedural scenes; scene i of a split is a function of (seed, split, i) alone."""

    name = "procedural"
    Config = WorldsConfig
    not_in_protocol: ClassVar[frozenset[str]] = SceneSource.not_in_protocol | {"cache_mb"}
    split_options: ClassVar[frozenset[str]] = frozenset({"scenes", "test_scenes"})

    def __init__(self, config: WorldsConfig) -> None:
        super().__init__(config)
        cache: ImageCache = {}
        counts: dict[Split, int] = {"train": config.scenes, "test": config.test_scenes}
        self.splits = {
            split: LazyScenes(
                {f"{split}/{index:06d}": index for index in range(count)},
                partial(WorldScene, config=config, split=split, cache=cache),
            )
            for split, count in counts.items()
        }

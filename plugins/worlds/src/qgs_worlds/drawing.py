"""Scenes drawn from a seed, and photos of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from random import Random
from typing import TYPE_CHECKING

import numpy as np

from qgs_worlds import materials
from qgs_worlds.cameras import CLEARANCE, Rig, draw_cameras
from qgs_worlds.casting import cast_depths, cast_light
from qgs_worlds.effects import develop, through_jpeg
from qgs_worlds.intervals import clearances
from qgs_worlds.lights import draw_effects, draw_lights
from qgs_worlds.places import KINDS, SHARES, Place, draw_place
from qgs_worlds.rows import World
from qgs_worlds.shadows import shadow_maps
from qgs_worlds.shapes import packed
from qgs_worlds.things import PLAIN, VARIED, Things, spread

if TYPE_CHECKING:
    from qgs_worlds.source import WorldsConfig

_MAPS = 4  # height maps of a world
_THUMB = (10, 10)  # pixels of the pictures by which a scene is exposed


@dataclass(frozen=True)
class Drawn:
    """A scene: its place, world and cameras; how its photos are developed.

    scale: factor of all lengths, which brings the median depth of what is seen into its range.
    """

    place: Place
    world: World
    rig: Rig
    effects: np.ndarray
    quality: int
    scale: float

    def photos(
        self, frames: Sequence[int], size: tuple[int, int], samples: int
    ) -> list[np.ndarray]:
        """Images (H, W, 3) uint8."""
        c2w, images = self.rig.c2w[list(frames)], []
        for frame, light in zip(
            frames,
            cast_light(self.world, c2w, self.rig.lens(size), size, samples),
            strict=True,
        ):
            image = np.empty((*size, 3), np.uint8)
            develop(image, light, self.effects, frame)
            images.append(through_jpeg(image, self.quality) if self.quality else image)
        return images

    def depths(self, frames: Sequence[int], size: tuple[int, int]) -> np.ndarray:
        """Depths (F, H, W) float32, 0 in the sky."""
        return cast_depths(self.world, self.rig.c2w[list(frames)], self.rig.lens(size), size)


def draw(key: list[int], config: "WorldsConfig") -> Drawn:
    """The scene of a key (seed, split, index). What an option changes is drawn on its own."""
    numbers = np.random.default_rng(key)
    plan, skin, shine, camera = (Random(int(numbers.integers(1 << 62))) for _ in range(4))
    maps = materials.height_maps(int(numbers.integers(1 << 31)), _MAPS)
    varied = config.shapes == "varied"
    kind = plan.choices(KINDS, SHARES)[0] if varied else "indoors"
    things = Things(plan, VARIED if varied else PLAIN, materials.COUNT, _MAPS)
    count = round(spread(plan, 4, config.complexity))
    place = draw_place(kind, plan, things, count, maps)
    shapes = packed(place.shapes)
    rig = draw_cameras(
        numbers, place, (shapes, maps), config.views_per_scene, config.cameras == "varied"
    )
    kept = clearances(shapes, rig.c2w[:, :3, 3]).min(0) > CLEARANCE
    kept[: place.fixed] = True
    lit = config.light == "varied"
    skins = materials.textures(skin, config.textures == "varied", lit)
    lights, air = draw_lights(shine, place, lit)
    shapes = np.ascontiguousarray(shapes[kept])
    shades = shadow_maps(shapes, maps, lights, *rig.sight(place))
    world = World(shapes, maps, skins, shades[0], air, *shades[1:])
    depths = np.empty((len(rig.c2w), *_THUMB), np.float32)
    light = cast_light(world, rig.c2w, rig.lens(_THUMB), _THUMB, 1, depths)
    effects, quality = draw_effects(camera, light, config.effects)
    scale, seen = 1.0, depths[np.isfinite(depths)]
    if config.depth is not None:
        median = float(np.median(seen)) if len(seen) else rig.distance
        scale = spread(Random(str(key)), *config.depth) / median
    return Drawn(place, world, rig, effects, quality, scale)

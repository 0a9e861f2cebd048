"""Scenes drawn from a seed, and photos of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from random import Random
from typing import TYPE_CHECKING

import numpy as np

from qgs_worlds.caster.casting import Size, cast, cast_depths
from qgs_worlds.caster.effects import Effects
from qgs_worlds.caster.intervals import clearances
from qgs_worlds.caster.shading import paint
from qgs_worlds.caster.shadows import shadow_maps
from qgs_worlds.caster.tables import World
from qgs_worlds.worlds import materials
from qgs_worlds.worlds.cameras import CLEARANCE, Rig, draw_cameras
from qgs_worlds.worlds.lights import draw_effects, draw_lights
from qgs_worlds.worlds.places import KINDS, SHARES, Place, draw_place
from qgs_worlds.worlds.shapes import packed
from qgs_worlds.worlds.things import PLAIN, VARIED, Things, spread

if TYPE_CHECKING:
    from qgs_worlds.worlds.source import WorldsConfig

# Height maps of a world.
_MAPS = 4
# Pixels of the pictures by which a scene is exposed, and its depth known.
_THUMB = (10, 10)


@dataclass(frozen=True)
class Drawn:
    """A scene: its place, world and cameras; how its photos are developed.

    scale: factor of all lengths, which brings the median depth of what is seen into its range.
    """

    place: Place
    world: World
    rig: Rig
    effects: Effects
    scale: float

    def photos(self, frames: Sequence[int], size: Size, samples: int) -> list[np.ndarray]:
        """Return images (H, W, 3) uint8."""
        light = np.empty((len(frames), *size, 3), np.float32)
        c2w = self.rig.c2w[list(frames)]
        cast(self.world, paint, light, c2w, self.rig.lens(size), samples)
        return [self.effects.photo(seen, frame) for seen, frame in zip(light, frames, strict=True)]

    def depths(self, frames: Sequence[int], size: Size) -> np.ndarray:
        """Return depths (F, H, W) float32, 0 in the sky."""
        return cast_depths(self.world, self.rig.c2w[list(frames)], self.rig.lens(size), size)


def draw(key: list[int], config: "WorldsConfig") -> Drawn:
    """Return the scene of a key (seed, split, index); each option has random numbers of its own."""
    numbers = np.random.default_rng(key)
    # four generators, so that an option changes its own part alone
    plan, skin, shine, camera = (Random(int(numbers.integers(1 << 62))) for _ in range(4))
    maps = materials.height_maps(int(numbers.integers(1 << 31)), _MAPS)
    varied = config.shapes == "varied"
    kind = plan.choices(KINDS, SHARES)[0] if varied else "indoors"
    things = Things(plan, VARIED if varied else PLAIN, materials.COUNT, _MAPS)
    count = round(spread(plan, 4, config.complexity))
    place = draw_place(kind, plan, things, count, maps)
    shapes = packed(place.shapes)
    moving = config.cameras == "varied"
    rig = draw_cameras(numbers, place, (shapes, maps), config.views_per_scene, moving)
    # things that stand where cameras are go
    kept = clearances(shapes, rig.c2w[:, :3, 3]).min(0) > CLEARANCE
    kept[: place.fixed] = True
    shapes = shapes[kept]
    lit = config.light == "varied"
    skins = materials.textures(skin, config.textures == "varied", lit)
    lights, air = draw_lights(shine, place, lit)
    lights, shadows = shadow_maps(shapes, maps, lights, *rig.sight(place))
    world = World(shapes, maps, skins, lights, air, shadows)
    light = np.empty((len(rig.c2w), *_THUMB, 3), np.float32)
    depths = np.empty((len(rig.c2w), *_THUMB), np.float32)
    cast(world, paint, light, rig.c2w, rig.lens(_THUMB), 1, depths)
    effects = draw_effects(camera, light, config.effects)
    scale = 1.0
    if config.depth is not None:
        seen = depths[np.isfinite(depths)]
        # a view of the sky alone has no depth
        median = float(np.median(seen)) if len(seen) else rig.distance
        scale = spread(Random(str(key)), *config.depth) / median
    return Drawn(place, world, rig, effects, scale)

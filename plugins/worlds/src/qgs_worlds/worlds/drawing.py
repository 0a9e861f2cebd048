"""Random abstract scenes (shapes, lights, cameras, camera effects), and their images."""

import math
from collections.abc import Sequence
from random import Random
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from qgs_worlds.caster import tables as s
from qgs_worlds.caster.casting import cast
from qgs_worlds.caster.effects import Effects
from qgs_worlds.caster.intervals import clearances
from qgs_worlds.caster.shading import paint
from qgs_worlds.caster.shadows import shadow_maps
from qgs_worlds.caster.shapes import packed
from qgs_worlds.caster.tables import World
from qgs_worlds.worlds import materials
from qgs_worlds.worlds.cameras import CLEARANCE, Rig, draw_cameras
from qgs_worlds.worlds.places import PLACES, SHARES, Place
from qgs_worlds.worlds.things import MAPS, PLAIN, VARIED, Things, any_angle, spread

if TYPE_CHECKING:
    from qgs_worlds.worlds.source import WorldsConfig

# Least and largest number of lamps, and how often the sun shines.
_LAMPS = {"indoors": (1, 2), "outdoors": (0, 1), "objects": (0, 2)}
_SUNNY = {"indoors": 0.5, "outdoors": 0.75, "objects": 0.45}

Light = tuple[float, Sequence[float], np.ndarray, int]
"""Row of LIGHT: 1 for a lamp, 0 for the sun; position or direction; RGB; 1 if it casts shadows."""
# Size in pixels of the images that determine exposure and depth of a scene.
_THUMB = (10, 10)


class Drawn(NamedTuple):
    """A random abstract scene: its layout (`place`), world, cameras (`rig`) and camera effects.

    scale: factor of all lengths, which brings the median visible depth into the range
    `WorldsConfig.depth`; 1 without such a range.
    """

    place: Place
    world: World
    rig: Rig
    effects: Effects
    scale: float


def draw(key: list[int], config: "WorldsConfig") -> Drawn:
    """Return the scene that `key` (seed, split, index) and the options `config` determine."""
    numbers = np.random.default_rng(key)
    # four generators, so that each option changes only its own part
    plan, skin, shine, camera = (Random(int(numbers.integers(1 << 62))) for _ in range(4))
    maps = materials.height_maps(int(numbers.integers(1 << 31)), MAPS)
    varied = config.shapes == "varied"
    kind = plan.choices([*PLACES], SHARES)[0] if varied else "indoors"
    things = Things(plan, VARIED if varied else PLAIN)
    count = round(spread(plan, 4, config.complexity))
    place = PLACES[kind](plan, things, count, maps)
    shapes = packed(place.shapes)
    moving = config.cameras == "varied"
    rig = draw_cameras(numbers, place, (shapes, maps), config.views_per_scene, moving)
    # remove things at the places of cameras
    kept = clearances(shapes, rig.c2w[:, :3, 3]).min(0) > CLEARANCE
    kept[: place.fixed] = True
    shapes = shapes[kept]
    lit = config.light == "varied"
    skins = materials.textures(skin, config.textures == "varied", lit)
    lights, air = draw_lights(shine, place, lit)
    lights, shadows = shadow_maps(shapes, maps, lights, *rig.sight(place))
    world = World(shapes, maps, skins, lights, air, shadows)
    depths, light = cast(world, rig.c2w, rig.lens(_THUMB), _THUMB, 1, paint)
    effects = draw_effects(camera, light, config.effects)
    scale = 1.0
    if config.depth is not None:
        seen = depths[np.isfinite(depths)]
        # a view that shows only sky has no depth
        median = float(np.median(seen)) if len(seen) else rig.distance
        scale = spread(Random(str(key)), *config.depth) / median
    return Drawn(place, world, rig, effects, scale)


def _tinted(rng: Random, by: float) -> np.ndarray:
    """Return random factors for R, G and B whose mean is 1.

    by: standard deviation of the factor of R, in stops (powers of 2). The factor of B falls as that
    of R rises.
    """
    warm = rng.gauss(0, by)
    green = rng.gauss(0, 0.3 * by)
    color = np.array([2**warm, 2**green, 2**-warm])
    return color / color.mean()


def draw_lights(rng: Random, place: Place, varied: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return random lights: a table of LIGHT, and a table of AIR with one row.

    varied: True gives sun and lamps at random, with shadows; False gives one white lamp near the
    top of `place`, without shadows. Lamps may be inside objects.
    """
    if not varied:
        lamp = (1.0, (0.3, 0.2, place.top - 0.3), 1.2, 0)
        return np.array([lamp], s.LIGHT), _air(rng, 0.5, 0.35, 0.5)
    outdoors = place.kind == "outdoors"
    sunny = rng.random() < _SUNNY[place.kind]
    tint = _tinted(rng, 0.25)
    lights = [_sun(rng)] if sunny else []
    low, high = _LAMPS[place.kind]
    # a scene that is not outdoors has at least one light
    low = low if sunny or outdoors else 1
    for number in range(rng.randint(low, high)):
        # shadow maps are slow to cast, so only the first lamp has them
        lights.append(_lamp(rng, place, number == 0 and not outdoors))
    above = spread(rng, 0.07, 0.5) * (1 if place.kind == "indoors" else 1.5) * tint
    below = rng.uniform(0.3, 0.9) * above * _tinted(rng, 0.15)
    return np.array(lights, s.LIGHT), _air(rng, above, below, rng.uniform(0.4, 0.9))


def _sun(rng: Random) -> Light:
    up = math.radians(rng.uniform(12, 70))
    angle = any_angle(rng)
    way = (math.cos(up) * math.cos(angle), math.cos(up) * math.sin(angle), math.sin(up))
    return 0.0, way, spread(rng, 1.2, 5) * _tinted(rng, 0.2), 1


def _lamp(rng: Random, place: Place, shadows: bool) -> Light:
    x, y, _ = map(rng.uniform, place.low, place.high)
    z = min(rng.uniform(0.6, 1.0) * place.top, place.top - 0.15)
    return 1.0, (x, y, z), spread(rng, 0.6, 4) * _tinted(rng, 0.4), int(shadows)


def _air(rng: Random, above: ArrayLike, below: ArrayLike, occlusion: float) -> np.ndarray:
    blue = np.array([0.45, 0.7, 1.15]) if rng.random() < 0.7 else _tinted(rng, 0.3)
    bright = spread(rng, 0.6, 2.2)
    row = (
        above,
        below,
        bright * rng.uniform(0.4, 1) * blue,  # zenith
        bright * (0.6 + 0.4 * blue),  # horizon
        rng.choice((0.0005, spread(rng, 0.0005, 0.02))),  # fog
        rng.choice((0.0, rng.uniform(0.2, 1.0), rng.uniform(0.2, 1.0))),  # clouds
        occlusion,
        rng.randrange(1 << 16),  # seed
        rng.uniform(0.12, 0.4),  # reach
    )
    return np.array([row], s.AIR)


def draw_effects(rng: Random, light: np.ndarray, varied: bool) -> Effects:
    """Return random camera effects; if not `varied`, neutral effects with the right exposure.

    light: small images (F, H, W, 3) of all F views in linear light, which determine the exposure.
    """
    luminance = light.reshape(-1, 3) @ (0.3, 0.6, 0.1)
    # the mean of logarithms, so that a bright sky leaves the rest visible
    grey = math.exp(float(np.log(luminance + 0.02).mean()))
    # the exponent of middle tones, which is steeper in cameras than in displays
    gamma = rng.uniform(1.15, 2.0) if varied else 1.6
    gains = np.full(3, 0.43**gamma / grey)
    if not varied:
        return Effects(gains, gamma)
    return Effects(
        gains=gains * (2 ** rng.uniform(-0.8, 0.8) * _tinted(rng, 0.12)),
        gamma=gamma,
        vignette=rng.choice((0.0, rng.uniform(0, 0.5))),
        noise=rng.choice((0.0, spread(rng, 0.003, 0.03))),
        seed=rng.randrange(1 << 16),
        quality=rng.choice((0, 0, rng.randint(60, 98))),
    )

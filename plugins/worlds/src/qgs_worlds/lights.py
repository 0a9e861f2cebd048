"""Light of a world: sun, lamps, the sky, what comes from all sides; settings of the camera."""

import math
from collections.abc import Sequence
from random import Random

import numpy as np

from qgs_worlds import rows as r
from qgs_worlds.places import Place
from qgs_worlds.things import spread

_LAMPS = {"indoors": (1, 2), "outdoors": (0, 1), "objects": (0, 2)}
_SUNNY = {"indoors": 0.5, "outdoors": 0.75, "objects": 0.45}


def _tinted(rng: Random, by: float) -> np.ndarray:
    """A colour of mean 1, from warm to cool, a little green or magenta."""
    warm, green = rng.gauss(0, by), rng.gauss(0, 0.3 * by)
    color = np.array([2**warm, 2**green, 2**-warm])
    return color / color.mean()


def draw_lights(rng: Random, place: Place, varied: bool) -> tuple[np.ndarray, np.ndarray]:
    """(L, LIGHT_FIELDS) and the air (AIR_FIELDS,). Lamps may be inside of things.

    Not varied: one white lamp above the middle, which throws no shadows, as in a studio.
    """
    if not varied:
        lamp = _lamp((0.3, 0.2, place.top - 0.3), np.full(3, 1.2), False)
        return np.array([lamp]), _air(rng, np.full(3, 0.5), np.full(3, 0.35), 0.5)
    lights, sunny = [], rng.random() < _SUNNY[place.kind]
    tint = _tinted(rng, 0.25)
    if sunny:
        up, angle = math.radians(rng.uniform(12, 70)), rng.uniform(0, math.tau)
        way = (math.cos(up) * math.cos(angle), math.cos(up) * math.sin(angle), math.sin(up))
        lights.append([0.0, *way, *(spread(rng, 1.2, 5) * _tinted(rng, 0.2)), 1.0])
    low, high = _LAMPS[place.kind]
    for number in range(rng.randint(max(low, 0 if sunny or place.kind == "outdoors" else 1), high)):
        at = [rng.uniform(a, b) for a, b in zip(place.low, place.high, strict=True)]
        at[2] = min(rng.uniform(0.6, 1.0) * place.top, place.top - 0.15)
        color = spread(rng, 0.6, 4) * _tinted(rng, 0.4)
        lights.append(_lamp(at, color, number == 0 and place.kind != "outdoors"))
    indoors = place.kind == "indoors"
    above = spread(rng, 0.07, 0.5) * (1 if indoors else 1.5) * tint
    below = rng.uniform(0.3, 0.9) * above * _tinted(rng, 0.15)
    return np.array(lights).reshape(-1, r.LIGHT_FIELDS), _air(
        rng, above, below, rng.uniform(0.4, 0.9)
    )


def _lamp(at: Sequence[float], color: np.ndarray, shadows: bool) -> list[float]:
    return [1.0, *at, *color, float(shadows)]


def _air(rng: Random, above: np.ndarray, below: np.ndarray, occlusion: float) -> np.ndarray:
    air = np.zeros(r.AIR_FIELDS)
    blue = np.array([0.45, 0.7, 1.15]) if rng.random() < 0.7 else _tinted(rng, 0.3)
    bright = spread(rng, 0.6, 2.2)
    air[r.ABOVE : r.ABOVE + 3], air[r.BELOW : r.BELOW + 3] = above, below
    air[r.ZENITH : r.ZENITH + 3] = bright * rng.uniform(0.4, 1) * blue
    air[r.HORIZON : r.HORIZON + 3] = bright * (0.6 + 0.4 * blue)
    air[r.FOG] = rng.choice((0.0005, spread(rng, 0.0005, 0.02)))
    air[r.CLOUDS] = rng.choice((0.0, rng.uniform(0.2, 1.0), rng.uniform(0.2, 1.0)))
    air[r.AIR_SEED] = rng.randrange(1 << 16)
    air[r.OCCLUSION], air[r.REACH] = occlusion, rng.uniform(0.12, 0.4)
    return air


def draw_effects(rng: Random, light: np.ndarray, varied: bool) -> tuple[np.ndarray, int]:
    """The camera (EFFECT_FIELDS,) of a scene and its JPEG quality, 0 for none.

    light: of small pictures of all its views, by which it is exposed.
    """
    luminance = light.reshape(-1, 3) @ (0.3, 0.6, 0.1)
    grey = math.exp(float(np.log(luminance + 0.02).mean()))
    effects = np.zeros(r.EFFECT_FIELDS)
    # the exponent of middle tones, which cameras' curves make steeper than that of displays
    gamma = rng.uniform(1.15, 2.0) if varied else 1.6
    effects[: r.GAMMA], effects[r.GAMMA] = 0.43**gamma / grey, gamma
    if not varied:
        return effects, 0
    effects[: r.GAMMA] *= 2 ** rng.uniform(-0.8, 0.8) * _tinted(rng, 0.12)
    effects[r.VIGNETTE] = rng.choice((0.0, rng.uniform(0, 0.5)))
    effects[r.NOISE] = rng.choice((0.0, spread(rng, 0.003, 0.03)))
    effects[r.NOISE_SEED] = rng.randrange(1 << 16)
    return effects, rng.choice((0, 0, rng.randint(60, 98)))

"""Light at known points: shadows, what is open to the sky, means of patterns."""

from itertools import product

import numpy as np
import pytest
from numba import njit
from qgs_worlds.caster import tables as s
from qgs_worlds.caster.casting import cast
from qgs_worlds.caster.shading import paint
from qgs_worlds.caster.shadows import shadow_maps
from qgs_worlds.caster.shapes import Primitive, Shape, packed
from qgs_worlds.caster.textures import color
from qgs_worlds.worlds.cameras import Rig
from tables import assert_near

GROUND = Shape(Primitive(s.BOX, (0.0, 0.0, -1.0), (50.0, 50.0, 1.0)))
WALL = Primitive(s.BOX, (1.0, 0.0, 1.0), (0.1, 5.0, 2.0))
DOOR = Primitive(s.BOX, (1.0, 0.0, 1.0), (0.4, 0.8, 2.5))
RING = Primitive(s.TORUS, (0.0, 0.0, 0.1), (1.0, 1.0, 1.0), extra=0.1)
TERRAIN = Primitive(s.HEIGHT, (0.0, 0.0, 0.0), (5.0, 5.0, 0.5))
THING = Shape(Primitive(s.BOX, (0.0, 0.0, 0.1), (0.2, 0.2, 0.1)))
LIGHT = 1.5


def texture_of(*fields):
    """One whose fields of these names are 1, and the others 0."""
    textures = np.zeros(1, s.TEXTURE)
    textures[[*fields]] = 1.0
    return textures


def seen_from_above(shapes, points, sun=(), ambient=0.0):
    """Light that comes from white shapes below points, to a camera 1 m high."""
    heights = np.zeros((1, 9, 9), np.float32)
    heights[0, 0, 0] = 1.0  # a peak far away
    textures = texture_of("period", "stretch", "colors")
    air = np.zeros(1, s.AIR)
    air["above"] = air["below"] = ambient
    air["occlusion"] = 1.0
    air["reach"] = 0.3
    lights = np.array([(0.0, sun, [LIGHT] * 3, 1)] if sun else [], s.LIGHT)
    table = packed(shapes)
    lights, shadows = shadow_maps(table, heights, lights, np.zeros(3), 6.0)
    world = s.World(table, heights, textures, lights, air, shadows)
    c2w = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (len(points), 1, 1))
    c2w[:, :3, 3] = [(x, y, 1.0) for x, y in points]
    _, images = cast(world, c2w, np.array([100.0, 100.0, 0.5, 0.5]), (1, 1), 1, paint)
    return images[:, 0, 0, 0].tolist()


def test_a_box_throws_its_shadow_away_from_the_sun():
    for height in (0.8, 0.03):
        box = Shape(Primitive(s.BOX, (0.0, 0.0, height / 2), (0.5, 0.5, height / 2)))
        sun = (0.5**0.5, 0.0, 0.5**0.5)  # the shadow is as long as the box is high
        points = [(-0.5 - 0.1 * height, 0.0), (-0.6 - height, 0.0), (0.6, 0.0), (-0.53, 0.6)]
        shaded, *others = seen_from_above([GROUND, box], points, sun)
        assert shaded < 0.7 * LIGHT * sun[2], "a pixel of the shadow map is 5 cm wide"
        assert others == pytest.approx([LIGHT * sun[2]] * 3, abs=1e-3)


def test_what_is_near_hides_the_sky():
    for where, shapes, x, open_ in (
        ("far from a wall", [GROUND, Shape(WALL)], -3.0, True),
        ("beside a wall", [GROUND, Shape(WALL)], 0.85, False),
        ("in a door", [GROUND, Shape(WALL, DOOR)], 1.0, True),
        ("in a ring", [GROUND, Shape(RING)], 0.0, True),
        ("on a terrain", [Shape(TERRAIN), THING], 0.0, True),
    ):
        (light,) = seen_from_above(shapes, [(x, 0.0)], ambient=1.0)
        assert (light > 0.999) if open_ else (light < 0.8), where


@njit
def mean(textures, footprint):
    """Of the red of a texture over 60 periods."""
    total = 0.0
    for i in range(200):
        for j in range(200):
            total += color(textures[0], 0.3041 * i, 0.2927 * j, footprint)[0]
    return total / 40_000


def test_patterns_keep_their_mean_from_afar():
    for kind, width in product(range(s.STRIPES, s.RINGS + 1), (0.15, 0.4, 0.7)):
        texture = texture_of("period", "stretch", "pattern_period", "aspect", "strength")
        texture["pattern"] = kind
        texture["width"] = width
        texture["colors"][0, 3, 0] = 1.0
        expected = pytest.approx(mean(texture, 10.0), abs=0.05)
        assert mean(texture, 1e-3) == expected, kind


def test_the_field_of_view_is_across_the_longer_side():
    rig = Rig(np.eye(4)[None], 90.0, 1.0, "walk")
    assert_near(rig.lens((40, 130)), [65, 65, 65, 20])
    assert_near(rig.lens((130, 40)), [65, 65, 20, 65])

"""Where rays enter shapes, against the signs of implicit functions sampled along them."""

from itertools import product
from random import Random

import numpy as np
import pytest
import torch
from qgs_worlds.caster import tables as s
from qgs_worlds.caster.intervals import clearances
from qgs_worlds.caster.raycast import trace
from qgs_worlds.caster.shapes import Primitive, Shape, any_turn, packed, rod
from qgs_worlds.worlds.materials import height_maps
from scipy.ndimage import map_coordinates

from qgs.geometry.poses import look_at

MAPS = height_maps(3, 2)
T = np.linspace(0, 6, 6000)
DOWN = (0.1, 0.2, -1.0)
"""No way of the tests goes there."""


def met(rows, maps, origin, way):
    """t at which a ray o + t d meets a shape, by the one pixel of an image, or inf."""
    c2w = look_at(*torch.tensor(np.stack([origin, way, DOWN]))).numpy()
    met = trace(1, 1, 0, 1, rows, maps, c2w, np.array([100.0, 100.0, 0.5, 0.5]))
    return met[0][0, 0] / np.linalg.norm(way)


def inside(primitive, points):
    """Negative inside of a primitive, positive outside."""
    turn = np.array(primitive.turn).reshape(3, 3)
    x, y, z = ((points - primitive.center) @ turn / primitive.half).T
    extra = primitive.extra
    flat = np.hypot(x, y)
    cube = abs(np.stack([x, y, z])).max(0) - 1
    field = MAPS[int(extra)]
    places = (np.stack([x, y]) + 1) / 2 * (len(field) - 1)
    return {
        s.ELLIPSOID: x * x + y * y + z * z - 1,
        s.BOX: cube,
        s.FRUSTUM: np.maximum(abs(z) - 1, flat - (1 + extra + (extra - 1) * z) / 2),
        s.CAPSULE: np.hypot(flat, z - np.clip(z, -extra, extra)) - 1,
        s.TORUS: np.hypot(flat - 1 + extra, z) - extra,
        s.HEIGHT: np.maximum(cube, z - map_coordinates(field, places, order=1, mode="nearest")),
    }[primitive.kind]


def first(shape, origin, way):
    """t at which a ray enters a shape, by sampling, or inf."""
    points = origin + T[:, None] * way
    f = inside(shape.body, points)
    if shape.cut:
        f = np.maximum(f, -inside(shape.cut, points))
    return T[np.argmax(f < 0)] if (f < 0).any() else np.inf


def drawn(kind, rng, middle):
    half = [rng.uniform(0.3, 1) for _ in range(3)]
    if kind in (s.CAPSULE, s.TORUS):
        half = [half[0]] * 3
    extra = {
        s.FRUSTUM: rng.choice((0.001, 0.4, 1.0)),
        s.CAPSULE: rng.uniform(0.3, 1),
        s.TORUS: rng.uniform(0.1, 0.4),
        s.HEIGHT: float(rng.randrange(2)),
    }.get(kind, 0.0)
    return Primitive(kind, middle, half, any_turn(rng), extra)


PAIRS = [*product(range(6), [None]), *product(range(4), range(3))]
"""Kinds of bodies, and of what is cut out of them."""


@pytest.mark.parametrize(("kind", "cut"), PAIRS)
def test_rays_enter_where_implicit_functions_say(kind, cut):
    rng = Random(7)
    draws = np.random.default_rng(7)
    found = []
    expected = []
    for _ in range(80):
        hole = None if cut is None else drawn(cut, rng, (0.3, -0.2, 0.4))
        shape = Shape(drawn(kind, rng, (0.1, 0.2, 0.3)), hole)
        origin = draws.normal(size=3)
        origin *= 3 / np.linalg.norm(origin)
        way = draws.normal(size=3) * 0.5 - origin
        way /= np.linalg.norm(way)
        found.append(met(packed([shape]), MAPS, origin, way))
        expected.append(first(shape, origin, way))
    hit, expected_hit = np.isfinite([found, expected])
    both = hit & expected_hit
    assert both.mean() > 0.2
    assert (hit != expected_hit).mean() < 0.015, "rays that graze"
    apart = abs(np.array(found)[both] - np.array(expected)[both])
    assert (apart < 3e-3).mean() > 0.98, "samples are 1 mm apart"


def test_thin_rods_far_away_are_met():
    for square in (False, True):
        rows = packed([Shape(rod((30.0, -1.0, 0.0), (30.0, 1.0, 0.5), 0.004, square))])
        assert abs(met(rows, MAPS, np.zeros(3), np.array([30, 0, 0.25])) - 1) <= 3e-4


def test_reach_is_that_of_the_lowest_point():
    points = np.random.default_rng(3).uniform(-2, 2, (100_000, 3))
    for kind in range(5):
        rng = Random(3)
        for _ in range(4):
            tilted = drawn(kind, rng, (0.0, 0.0, 0.0))
            lowest = -points[inside(tilted, points) < 0, 2].min()
            assert lowest <= tilted.reach() < lowest + 0.2, kind


def test_clearances_are_distances_to_boxes():
    along_x = (0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0)
    body = Primitive(s.CAPSULE, (1.0, 0.0, 0.0), (0.5, 0.5, 0.5), along_x, extra=1.0)
    points = np.array([[1.0, 0.0, 2.0], [3.0, 0.0, 0.5], [1.9, 0.1, 0.4], [3.0, 0.0, 1.5]])
    expected = [1.5, 1.0, 0.0, np.hypot(1, 1)]
    assert clearances(packed([Shape(body)]), points)[:, 0] == pytest.approx(expected, abs=1e-6)

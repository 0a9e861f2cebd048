import numpy as np
import pytest
from qgs_worlds.caster.casting import cast
from qgs_worlds.caster.intervals import hit
from qgs_worlds.caster.tables import LIGHT, TEXTURE, Room
from qgs_worlds.rooms.furniture import box, cylinder, packed, sphere
from qgs_worlds.rooms.plan import NO_HEIGHTS


def hits(shape, x, y):
    """Return how far along the x axis a ray from (x, y, 1) meets a shape."""
    origin, forward = (tuple(map(np.float32, place)) for place in ((x, y, 1), (1, 0, 0)))
    return hit(packed((1.0, 1.0, 1.0), [shape])["body"][1], origin, forward)


def test_hits_are_where_geometry_puts_them():
    block = box(5, 0, 0, 2, 2, 2, 0)
    round_ = sphere(5, 0, 0, 1.0, 0), cylinder(5, 0, 0, 1.0, 2.0, 0)
    for shape in (block, *round_):
        assert hits(shape, 0, 0) == pytest.approx(4)
        assert np.isinf([hits(shape, 0, 1.2), hits(shape, 9, 0)]).all()
    for shape in round_:
        assert hits(shape, 0, 0.5) == pytest.approx(5 - np.sqrt(0.75))
    turned = box(0, 0, 0, 2, 2, 2, 0).moved(5, 0, np.pi / 4)
    assert hits(turned, 0, 0) == pytest.approx(5 - np.sqrt(2))  # its corner


def test_depth_is_z_along_the_camera():
    c2w = np.eye(4)
    c2w[:3] = [0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1]
    size = (8.0, 40.0, 40.0)
    shapes = packed(size, [box(1.75, 0, 0.9, 0.5, 0.2, 0.2, 0)])
    nothing = np.zeros((2, 2))
    room = Room(shapes, NO_HEIGHTS, np.zeros(7, TEXTURE), size, np.zeros(2, LIGHT), nothing)
    (depth,) = cast(room, c2w[None], np.array([20.0, 20.0, 10.5, 10.5]), (21, 21))
    assert depth[[10, 4, 4], [10, 3, 17]] == pytest.approx([1.5, 4, 4])

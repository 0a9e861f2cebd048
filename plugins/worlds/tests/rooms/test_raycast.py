import numpy as np
import pytest
from qgs_worlds.caster.intervals import hit
from qgs_worlds.rooms.furniture import box, cylinder, packed, sphere


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

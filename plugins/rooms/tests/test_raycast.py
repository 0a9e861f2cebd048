import numpy as np
import pytest
from qgs_rooms.casting import cast_depths
from qgs_rooms.intersections import hit
from qgs_rooms.shapes import TEXTURE_FIELDS, Room, box, cylinder, sphere


def vector(*values):
    return tuple(map(np.float32, values))


FORWARD = vector(1, 0, 0)


def test_hits_are_where_geometry_puts_them():
    rows = [
        box(5, 0, 0, (2, 2, 2), 0).row(),
        sphere(5, 0, 0, 1.0, 0).row(),
        cylinder(5, 0, 0, 1.0, 2.0, 0).row(),
    ]
    shapes, origin = np.array(rows, np.float32), vector(0, 0, 1)
    assert [hit(shapes, i, origin, FORWARD) for i in range(3)] == pytest.approx([4.0] * 3)
    off = vector(0, 0.5, 1)
    assert hit(shapes, 1, off, FORWARD) == pytest.approx(5 - np.sqrt(0.75))
    assert hit(shapes, 2, off, FORWARD) == pytest.approx(5 - np.sqrt(0.75))
    assert all(np.isinf(hit(shapes, i, vector(0, 1.2, 1), FORWARD)) for i in range(3))
    assert all(np.isinf(hit(shapes, i, vector(9, 0, 1), FORWARD)) for i in range(3))


def test_a_turned_box_shows_its_corner():
    turned = box(0, 0, 0, (2, 2, 2), 0).moved(5, 0, np.pi / 4)
    shapes = np.array([turned.row()], np.float32)
    assert hit(shapes, 0, vector(0, 0, 1), FORWARD) == pytest.approx(5 - np.sqrt(2))


def test_depth_is_z_along_the_camera():
    c2w = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1]], float)
    shapes = np.array([box(1.75, 0, 0.9, (0.5, 0.2, 0.2), 0).row()], np.float32)
    room = Room(shapes, np.zeros((6, TEXTURE_FIELDS)), (8.0, 40.0, 40.0), np.zeros((2, 4)))
    intrinsics = np.array([20.0, 20.0, 10.5, 10.5])
    (depth,) = cast_depths(room, c2w[None], intrinsics, (21, 21))
    assert depth[10, 10] == pytest.approx(1.5)
    assert depth[4, 3] == pytest.approx(4.0)
    assert depth[4, 17] == pytest.approx(4.0)

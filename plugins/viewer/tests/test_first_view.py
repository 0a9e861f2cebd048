"""Where viewers stand at first."""

import math

import pytest
import torch
from qgs_viewer.look import Look

from qgs.geometry.poses import look_at
from qgs.types import Cameras, Gaussians, Views

pytest.importorskip("viser", reason="viser is not installed: pip install query-gaussians-viewer")


def around(turn: float, count: int = 8, up: tuple[float, float, float] = (0, 0, 1)) -> Look:
    """Cameras on a part `turn` of a circle of radius 3, upright by `up`, around a small cloud."""
    angles = torch.arange(count) / count * turn * 2 * math.pi
    eye = torch.stack([3 * angles.cos(), 3 * angles.sin(), torch.full((count,), 0.5)], -1)
    c2w = look_at(eye, -eye, -torch.tensor(up).float().expand_as(eye))
    lenses = torch.tensor([64.0, 64, 32, 32]).expand(1, count, 4)
    views = Views(torch.rand(1, count, 3, 64, 64), Cameras(c2w[None], lenses, (64, 64)))
    means = torch.randn(1, 50, 3) * 0.2
    quats = torch.tensor([1.0, 0, 0, 0]).expand(1, 50, 4)
    sizes, solid = torch.full((1, 50, 3), 0.05), torch.full((1, 50), 0.9)
    return Look(Gaussians(means, sizes, quats, solid, means.sigmoid()), views)


def test_cameras_around_something_are_seen_from_outside() -> None:
    from qgs_viewer.server import first_eye

    look = around(1.0)
    eye, target = first_eye(look)
    middle = look.gaussians.means[0].double().median(0).values.numpy()
    assert abs(target - middle).max() < 1e-6
    assert ((eye - middle) ** 2).sum() ** 0.5 > 4
    assert eye[2] > 0.5  # above them


def test_up_is_that_of_the_cameras() -> None:
    from qgs_viewer.server import first_eye, quiet_server, stand, up_of

    for turn in (0.2, 1.0):
        up = up_of(around(turn))
        assert float(up[2]) > 0.95
        assert float(up.norm()) == pytest.approx(1)
    look = around(0.2)
    with quiet_server() as server:
        stand(server, look)
        assert server.initial_camera.up[2] > 0.95
    eye, target = first_eye(look)
    assert (target - eye) @ (torch.zeros(3).numpy() - eye) > 0

"""Cameras on arcs, what they may look at, and a scene that a camera walks past."""

import torch
from tables import assert_equal

from qgs.contracts import Scene
from qgs.geometry.poses import look_at
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import Cameras, Gaussians

FRAMES = 6
SIDE = 64


def arc(degrees, radius, rise=0.0):
    """Poses (V, 4, 4) of cameras around the origin, which they look at, y down."""
    angles = torch.as_tensor(degrees).double().deg2rad()
    axes = torch.stack([angles.sin(), rise * angles, angles.cos()], -1)
    return look_at(-radius * axes, axes, torch.tensor([0.0, 1.0, 0.0]))


def along_x(places):
    """Poses (V, 4, 4) of cameras at places along the x axis that look along z."""
    places = torch.as_tensor(places)
    c2w = torch.eye(4).to(places).repeat(len(places), 1, 1)
    c2w[:, 0, 3] = places
    return c2w


def pinhole(c2w, lens=None, size=(SIDE, SIDE)):
    """Cameras at poses (..., 4, 4), by default with the width as focal length, and centred."""
    height, width = size
    lens = lens or (width, width, width / 2, height / 2)
    return Cameras(c2w, torch.tensor(lens).to(c2w).expand(*c2w.shape[:-2], 4), size)


def assert_rigid(c2w):
    """Poses turn and mirror nothing."""
    turn = torch.as_tensor(c2w)[..., :3, :3]
    assert torch.allclose(turn @ turn.mT, torch.eye(3).to(turn), 0, 1e-5)
    assert (torch.linalg.det(turn) > 0).all()


def cloud(number, seed=0):
    """Gaussians (1, G) around the origin."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(1, number, 7, generator=generator)
    even = torch.rand(1, number, 7, generator=generator)
    quats = torch.nn.functional.normalize(normal[..., 3:], dim=-1)
    scales = 0.05 + 0.1 * even[..., :3]
    return Gaussians(0.3 * normal[..., :3], scales, quats, 0.3 + 0.6 * even[..., 3], even[..., 4:])


def covariances(gaussians):
    axes = quat_to_matrix(gaussians.quats) * gaussians.scales[..., None, :]
    return axes @ axes.mT


def assert_alike(found, given):
    """Gaussians (1, G) are the given ones but for rounding and an order, which is undone: (G,)."""
    found = found[0][torch.cdist(given.means[0], found.means[0]).argmin(1)]
    for part in ("means", "opacities", "colors"):
        assert_equal(getattr(found, part), getattr(given, part)[0], atol=0.01)
    assert_equal(covariances(found), covariances(given)[0], atol=4e-3)
    return found


class Walk(Scene):
    """Photos of noise by cameras on an arc that look at one point, principal point off centre."""

    name = "walk"
    cameras = pinhole(arc(range(-30, 31, 12), 3, 0.1), (59.0, 65.0, 35.0, 30.0))

    def images(self, frames):
        every = torch.rand(FRAMES, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(1))
        return every[list(frames)]

    def frame_name(self, frame):
        return f"photos/{frame:02d}.png"

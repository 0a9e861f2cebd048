"""Points on what photos show, of a painted wall whose place is known."""

import pytest
import torch
from qgs_refine.refining import partly_swept
from qgs_refine.sweeping import swept
from torch import Tensor

from qgs.geometry.poses import look_at
from qgs.types import Cameras, Gaussians, Views

SIDE = 48


def paint(x: Tensor, y: Tensor) -> Tensor:
    """RGB (..., 3) of the wall z = 0, different everywhere that a camera sees."""
    waves = [(1.0, 7.0, 3.0), (2.0, -4.0, 8.0), (3.0, 5.0, -6.0)]
    return torch.stack([0.5 + 0.4 * torch.sin(a + b * x + c * y) for a, b, c in waves], -1)


def photos(eyes: Tensor) -> Views:
    """Photos (1, V) of the wall from `eyes` (V, 3), towards the origin."""
    c2w = look_at(eyes, -eyes, torch.tensor([0.0, 1, 0]).expand_as(eyes))
    lens = torch.tensor([60.0, 60, SIDE / 2, SIDE / 2])
    steps = (torch.arange(SIDE) + 0.5 - SIDE / 2) / 60
    rows, columns = torch.meshgrid(steps, steps, indexing="ij")
    rays = torch.stack([columns, rows, torch.ones_like(rows)], -1)
    images = []
    for pose in c2w:
        turned = rays @ pose[:3, :3].T
        hit = pose[:3, 3] - turned * (pose[2, 3] / turned[..., 2:])
        images.append(paint(hit[..., 0], hit[..., 1]).permute(2, 0, 1))
    cameras = Cameras(c2w[None], lens.expand(1, len(eyes), 4), (SIDE, SIDE))
    return Views(torch.stack(images)[None], cameras)


def row_of_eyes(count: int, apart: float = 0.2) -> Tensor:
    x = apart * (torch.arange(count) - (count - 1) / 2)
    return torch.stack([x, torch.zeros(count), torch.full((count,), -2.0)], -1)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("count", [2, 9])
@pytest.mark.parametrize("size", [1.0, 2.0, 4.0])  # far from the truth, 2, too
def test_points_lie_on_the_wall_in_its_colours(count: int, size: float) -> None:
    views = photos(row_of_eyes(count))
    found = swept(views, 400, size, generator())
    off = found.means[0, :, 2].abs()
    assert (off < 0.15).float().mean() > 0.85  # depths are tried in steps of 7 %
    near = found.means[0, off < 0.15]
    colors = found.colors[0, off < 0.15]
    assert (paint(near[:, 0], near[:, 1]) - colors).abs().mean() < 0.08
    assert found.scales.median() == pytest.approx(2 * 2 / 60, rel=0.1)  # two pixels at depth 2


def test_without_evidence_the_depth_is_the_size() -> None:
    """Of photos that show nothing in common."""
    eyes = row_of_eyes(2)
    views = photos(eyes)
    c2w = views.cameras.c2w.clone()
    c2w[0, 1, :3, 0] *= -1  # turned about
    c2w[0, 1, :3, 2] *= -1
    views = Views(views.images, Cameras(c2w, views.cameras.intrinsics, views.cameras.size))
    found = swept(views, 50, 3.0, generator())
    axes, ways = c2w[0, :, :3, 2], found.means[0, :, None] - eyes
    depths = (ways * axes).sum(-1).amax(-1)  # before the one that shows it
    assert (depths / 3 - 1).abs().max() < 0.04  # half of a step between the depths that are tried


def test_more_pixels_than_are_swept_at_once() -> None:
    found = swept(photos(row_of_eyes(3)), 4000, 2.0, generator())
    assert found.count == 4000
    assert (found.means[0, :, 2].abs() < 0.15).float().mean() > 0.85


def test_half_makes_room_and_the_most_opaque_stay() -> None:
    opacities = torch.linspace(0.1, 0.9, 11)[None]
    quats = torch.tensor([1.0, 0, 0, 0]).expand(1, 11, 4)
    given = Gaussians(torch.randn(1, 11, 3), torch.ones(1, 11, 3), quats, opacities, quats[..., 1:])
    views = photos(row_of_eyes(3))
    mixed = partly_swept(given, views, 9, 0.5, generator())
    assert mixed.count == 9
    assert torch.equal(mixed.means[:, :5], given.most_opaque(5).means)
    alone = partly_swept(given, views.select([1]), 9, 0.5, generator())
    assert torch.equal(alone.means, given.most_opaque(9).means)

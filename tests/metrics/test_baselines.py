"""Copying the nearest input view, and the mean colour."""

import math

import pytest
import torch
from torch import Tensor

from qgs.contracts import Column
from qgs.data.samples import stack_views
from qgs.metrics.baselines import mean_colour, nearest_input, worse_than_nearest
from qgs.types import Cameras, Views


def pose(x: float, turn: float = 0.0) -> Tensor:
    """A camera at (x, 0, 0), turned by `turn` radians about y."""
    c, s = math.cos(turn), math.sin(turn)
    return torch.tensor([[c, 0, s, x], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])


def cameras(*poses: Tensor) -> Cameras:
    c2w = torch.stack(poses)[None]
    return Cameras(c2w, torch.tensor([8.0, 8.0, 4.0, 4.0]).expand(1, len(poses), 4), (8, 8))


def views(*poses: Tensor) -> Views:
    images = torch.rand(1, len(poses), 3, 8, 8, generator=torch.Generator().manual_seed(0))
    return Views(images, cameras(*poses))


def test_the_nearest_centre_is_copied() -> None:
    inputs = views(pose(0.0), pose(1.0), pose(3.0))
    found = nearest_input(inputs, cameras(pose(2.7), pose(0.1), pose(1.4)))
    torch.testing.assert_close(found, inputs.images[:, [2, 0, 1]])


def test_direction_decides_between_cameras_in_one_place() -> None:
    inputs = views(pose(0.0, 1.5), pose(0.0, -1.5), pose(0.0, 0.1))
    found = nearest_input(inputs, cameras(pose(0.0, 0.0), pose(0.0, -1.2)))
    torch.testing.assert_close(found, inputs.images[:, [2, 1]])


def test_scale_of_the_scene_does_not_matter() -> None:
    small, large = (
        nearest_input(views(pose(0.0, 0.3), pose(scale)), cameras(pose(0.6 * scale)))
        for scale in (0.01, 100.0)
    )
    assert torch.equal(small, large)


def test_each_scene_copies_its_own_views() -> None:
    one, other = views(pose(0.0), pose(1.0)), views(pose(1.0), pose(0.0))
    both = stack_views([one, Views(1 - other.images, other.cameras)])
    target = views(pose(0.1))
    found = nearest_input(both, stack_views([target, target]).cameras)
    torch.testing.assert_close(found, torch.stack([one.images[0, :1], 1 - other.images[0, 1:]]))


def test_mean_colour_is_flat_and_the_best_flat_guess() -> None:
    inputs = views(pose(0.0), pose(1.0))
    found = mean_colour(inputs, cameras(pose(0.5), pose(2.0)))
    assert found.shape == (1, 2, 3, 8, 8)
    assert float(found.std((-1, -2)).max()) < 1e-6
    errors = [(inputs.images - found[:, :1] - d).square().mean() for d in (0, 0.01, -0.01)]
    assert errors[0] < min(errors[1:])


@pytest.mark.parametrize(
    ("better", "model", "nearest", "remarked"),
    [
        ("higher", 14.457, 14.463, False),
        ("higher", 14.454, 14.463, True),
        ("lower", 0.31, 0.30, True),
        ("lower", 0.304, 0.301, False),
        ("higher", 15.0, None, False),
    ],
)
def test_a_model_is_worse_only_where_the_shown_figures_differ(
    better, model, nearest, remarked
) -> None:
    text = worse_than_nearest(Column("score", better, 2), model, nearest, "try this")
    assert bool(text) == remarked
    assert ("try this" in text) == remarked

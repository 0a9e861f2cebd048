"""Copying the nearest input view, and the mean colour."""

import torch
import yaml
from torch.testing import assert_close

from qgs.contracts import Column
from qgs.data.samples import stack_views
from qgs.metrics.baselines import mean_colour, nearest_input, worse_than_nearest
from qgs.types import Cameras, Views


def cameras(x, turn=()):
    """Cameras along the x axis, turned by radians about y."""
    c2w = torch.eye(4).repeat(1, len(x), 1, 1)
    skew = torch.tensor([[0, 0, 1.0], [0, 0, 0], [-1, 0, 0]])
    c2w[0, : len(turn), :3, :3] = torch.tensor(turn)[:, None, None].mul(skew).matrix_exp()
    c2w[0, :, 0, 3] = torch.tensor(x)
    return Cameras(c2w, torch.full((1, len(x), 4), 4.0), (8, 8))


def views(x, turn=()):
    return Views(torch.rand(1, len(x), 3, 8, 8), cameras(x, turn))


def test_the_nearest_view_is_copied_whatever_the_scale_of_the_scene():
    for inputs, targets, nearest in (
        (views([0, 1, 3.0]), cameras([2.7, 0.1, 1.4]), [2, 0, 1]),
        (views([0, 0, 0.0], [1.5, -1.5, 0.1]), cameras([0, 0.0], [0, -1.2]), [2, 1]),
        (views([0, 0.01], [0.3, 0]), cameras([0.004]), [1]),
        (views([0, 100.0], [0.3, 0]), cameras([40.0]), [1]),
    ):
        found = nearest_input(inputs, targets)
        assert torch.equal(found, inputs.images[:, nearest]), targets


def test_each_scene_copies_its_own_views():
    both = stack_views([views([0, 1.0]), views([1.0, 0])])
    targets = Cameras(both.cameras.c2w[:1, :1].repeat(2, 1, 1, 1), torch.ones(2, 1, 4), (8, 8))
    found = nearest_input(both, targets)
    assert torch.equal(found, torch.stack([both.images[0, :1], both.images[1, 1:]]))


def test_mean_colour_is_flat():
    inputs = views([0, 1.0])
    found = mean_colour(inputs, cameras([0.5, 2.0]))
    mean = inputs.images.mean((1, 3, 4))[:, None, :, None, None]
    assert_close(found, mean.expand(1, 2, 3, 8, 8))


FIGURES = """
- [higher, 14.457, 14.463, false]
- [higher, 14.454, 14.463, true]
- [lower, 0.31, 0.30, true]
- [lower, 0.304, 0.301, false]
- [higher, 15.0, null, false]
"""
"""Which is better, the model's figure, the nearest photo's, and whether it is remarked on."""


def test_a_model_is_worse_only_where_the_shown_figures_differ():
    for better, model, nearest, remarked in yaml.safe_load(FIGURES):
        text = worse_than_nearest(Column("score", better, 2), model, nearest, "try this")
        assert ("try this" in text) == bool(text) == remarked, (model, nearest)

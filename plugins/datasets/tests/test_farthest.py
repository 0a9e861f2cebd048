"""DepthSplat's sampler of views: how many inputs, how far apart, and targets."""

from itertools import islice

import numpy as np
import pytest
import torch
from line_scenes import Line
from qgs_datasets.farthest import Farthest, farthest_points

from qgs.composer import RecipeError, resolve
from qgs.contracts import ViewsConfig
from qgs.contracts.schedule import END
from qgs.data.stream import trained_domain, training_batches

VIEWS = ViewsConfig(inputs=6, targets=8)


def farthest(**options):
    plain = {"min_gap": 20, "max_gap": 50, "initial_min_gap": 15, "initial_max_gap": 30}
    return Farthest(Farthest.Config(**(plain | {"warm_up_steps": 100} | options)))


def test_numbers_of_inputs_and_gaps():
    for step, count, gaps in (
        (0, 2, (5, 10)),  # 6 // 2 times shorter
        (100, 2, (6, 16)),
        (101, 3, (10, 25)),
        (102, 4, (20, 50)),
        (104, 6, (20, 50)),
        (END, 6, (20, 50)),
    ):
        found = set()
        for seed in range(120):
            inputs, targets = farthest().draw(Line(80), VIEWS, np.random.default_rng(seed), step)
            assert list(inputs) == sorted({*inputs})
            gap = inputs[-1] - inputs[0]
            found.add(gap)
            # on a line the ends are the farthest points, so inputs are the ends of the gap
            assert (len(inputs), len(targets), len({*targets})) == (count, 8, min(8, gap + 1))
            assert inputs[0] <= min(targets) <= max(targets) <= inputs[-1]
        assert (min(found), max(found)) == gaps


class Bend(Line):
    """Cameras that wait at the origin and go away at the end."""

    @property
    def cameras(self):
        cameras = super().cameras
        cameras.c2w[:, 0, 3] = torch.arange(self.count).clamp_min(self.count - 4).float()
        return cameras


def test_inputs_stand_where_cameras_move():
    sampler, rng = farthest(min_gap=20, max_gap=20), np.random.default_rng(0)
    inputs, _ = sampler.draw(Bend(21), ViewsConfig(inputs=4, targets=8), rng, END)
    assert inputs[1:] == (18, 19, 20)


def test_points_farthest_from_each_other():
    points = torch.zeros(6, 3)
    points[:, 0] = torch.tensor([0, 1, 5, 5, 2, 9])
    # the mean is at 3.7: 9 is farthest, then 0, then 5, then 2; 5 again only after 1
    assert farthest_points(points, 6) == [5, 0, 2, 4, 1, 3]


def test_more_inputs_than_views():
    options = ["view_sampler={type: datasets/farthest, fewest: 3}", "views.inputs=2"]
    with pytest.raises(RecipeError, match="fewest"):
        resolve("tiny/tokengs_bounded.yaml", options)


def test_batches_have_as_many_inputs_in_a_step_and_their_ranges_are_measured():
    gaps = "min_gap: 3, max_gap: 7, initial_min_gap: 3, initial_max_gap: 7"
    sampler = f"view_sampler={{type: datasets/farthest, {gaps}}}"
    options = [sampler, "views.inputs=4", "data.image_size=[16, 16]"]
    recipe = resolve("tiny/tokengs_bounded.yaml", options)
    source, drawn = recipe.build_data(), recipe.build_view_sampler()
    batches = training_batches(source, recipe.views, 2, 0, 0, sampler=drawn, accumulate=2)
    counts = [batch.inputs.images.shape[1] for batch in islice(batches, 8)]
    assert counts == [2, 2, 3, 3, 4, 4, 2, 2]
    assert trained_domain(source, recipe.views, 0, drawn, steps=600).ranges["views"] == (2, 4)

"""pixelSplat's and DepthSplat's samplers of views: gaps and inputs that follow the training."""

from itertools import islice

import numpy as np
import pytest
import torch
from line_scenes import Line
from qgs_photos.datasets.bounded import Bounded
from qgs_photos.datasets.farthest import Farthest

from qgs.contracts import ViewsConfig
from qgs.contracts.schedule import END
from qgs.data.stream import trained_domain, training_batches
from qgs.evaluate.plan import evaluation_samples
from qgs.recipe import RecipeError, resolve

TWO = ViewsConfig(inputs=2, targets=3, gap=(2, 5))
SIX = ViewsConfig(inputs=6, targets=8)


def bounded(**options):
    plain = {"min_gap": 6, "max_gap": 12, "initial_min_gap": 4, "initial_max_gap": 6, "margin": 1}
    return Bounded(Bounded.Config(**(plain | {"warm_up_steps": 100} | options)))


def farthest(**options):
    plain = {"min_gap": 20, "max_gap": 50, "initial_min_gap": 15, "initial_max_gap": 30}
    return Farthest(Farthest.Config(**(plain | {"warm_up_steps": 100} | options)))


def seeded(seed=0):
    return np.random.default_rng(seed)


def test_the_gap_widens_as_in_pixelsplat():
    """initial + int((final - initial) * step / warm_up_steps), at most the final number."""
    steps = {0: (4, 6), 50: (5, 9), 99: (5, 11), 100: (6, 12), 500: (6, 12), END: (6, 12)}
    for step, bounds in steps.items():
        gaps = set()
        places = set()
        for seed in range(120):
            (left, right), targets = bounded().draw(Line(30), TWO, seeded(seed), step)
            gaps.add(right - left)
            places.update(target - left for target in targets)
            assert max(targets) < right
            assert len(targets) == 3
        assert (min(gaps), max(gaps)) == bounds
        assert min(places) == 1


def test_short_scenes_and_several_inputs():
    assert bounded().draw(Line(5), TWO, seeded(), END)[0] == (0, 4)
    with pytest.raises(ValueError, match="5 frames"):
        bounded(margin=3).draw(Line(5), TWO, seeded(), END)
    inputs, _ = bounded().draw(Line(30), ViewsConfig(inputs=4, targets=1), seeded(), END)
    assert len(inputs) == 4
    assert list(inputs) == sorted({*inputs})


def opened(*options):
    """A recipe, its data and its sampler."""
    recipe = resolve("tiny/tokengs_bounded.yaml", [*options, "data.image_size=[16, 16]"])
    return recipe, recipe.build_data(), recipe.build_view_sampler()


def batches(recipe, source, sampler, start, count):
    """Two samples a batch, two batches a step."""
    stream = training_batches(source, recipe.views, 2, 0, start, sampler=sampler, accumulate=2)
    return [*islice(stream, count)]


def test_a_training_widens_the_gap_and_resumes_where_it_was():
    """The warm-up of 5 steps ends with sample 20."""
    parts = opened("view_sampler.warm_up_steps=5", "view_sampler.initial_max_gap=2")
    recipe, source, sampler = parts

    def gaps(start, count):
        drawn = [frames for batch in batches(*parts, start, count) for frames in batch.input_frames]
        return [frames[-1] - frames[0] for frames in drawn]

    whole = gaps(0, 14)
    assert gaps(9, 5) == whole[18:]
    assert {*whole[:4]} == {2}
    assert max(whole[4:]) > 3
    for number, gap in enumerate(whole):
        low, high = sampler.gaps(number // 4)
        assert low <= gap <= high
    samples = evaluation_samples(source, recipe.views, recipe.evaluation, sampler)
    found = [sample.input_frames[-1] - sample.input_frames[0] for sample in samples]
    assert min(found) in {3, 7}
    assert max(found) > 3


def test_numbers_of_inputs_and_gaps_as_in_depthsplat():
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
            inputs, targets = farthest().draw(Line(80), SIX, seeded(seed), step)
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
    sampler = farthest(max_gap=20)
    four = ViewsConfig(inputs=4, targets=8)
    assert sampler.draw(Bend(21), four, seeded(), END)[0][1:] == (18, 19, 20)


def test_more_inputs_than_views():
    with pytest.raises(RecipeError, match="fewest"):
        opened("view_sampler={type: datasets/farthest, fewest: 3}", "views.inputs=2")


def test_batches_have_as_many_inputs_in_a_step_and_their_ranges_are_measured():
    gaps = "min_gap: 3, max_gap: 7, initial_min_gap: 3, initial_max_gap: 7"
    sampler = f"view_sampler={{type: datasets/farthest, {gaps}}}"
    parts = opened(sampler, "views.inputs=4")
    recipe, source, drawn = parts
    counts = [batch.inputs.images.shape[1] for batch in batches(*parts, 0, 8)]
    assert counts == [2, 2, 3, 3, 4, 4, 2, 2]
    assert trained_domain(source, recipe.views, 0, drawn, steps=600).ranges["views"] == (2, 4)

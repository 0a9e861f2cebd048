"""pixelSplat's sampler of views: bounds of the gap, and how they follow the training."""

from itertools import islice

import numpy as np
import pytest
from line_scenes import Line
from qgs_datasets.bounded import Bounded

from qgs.composer import resolve
from qgs.contracts import ViewsConfig
from qgs.contracts.schedule import END
from qgs.data.evaluation import evaluation_samples
from qgs.data.stream import training_batches

OPTIONS = {"min_gap": 6, "max_gap": 12, "initial_min_gap": 4, "initial_max_gap": 6}
VIEWS = ViewsConfig(inputs=2, targets=3, gap=(2, 5))


def bounded(**options):
    return Bounded(Bounded.Config(**(OPTIONS | {"margin": 1, "warm_up_steps": 100} | options)))


def test_the_gap_widens_as_in_pixelsplat():
    """initial + int((final - initial) * step / warm_up_steps), at most the final number."""
    cases = (
        (0, (4, 6)),
        (50, (5, 9)),
        (99, (5, 11)),
        (100, (6, 12)),
        (500, (6, 12)),
        (END, (6, 12)),
    )
    for step, bounds in cases:
        gaps, places = set(), set()
        for seed in range(120):
            rng = np.random.default_rng(seed)
            (left, right), targets = bounded().draw(Line(30), VIEWS, rng, step)
            gaps.add(right - left)
            places.update(target - left for target in targets)
            assert max(targets) < right
            assert len(targets) == 3
        assert (min(gaps), max(gaps)) == bounds
        assert min(places) == 1


def test_short_scenes_and_several_inputs():
    rng = np.random.default_rng(0)
    assert bounded().draw(Line(5), VIEWS, rng, END)[0] == (0, 4)
    with pytest.raises(ValueError, match="5 frames"):
        bounded(margin=3).draw(Line(5), VIEWS, rng, END)
    inputs, _ = bounded().draw(Line(30), ViewsConfig(inputs=4, targets=1), rng, END)
    assert len(inputs) == 4
    assert list(inputs) == sorted({*inputs})


def gaps(batches):
    return [frames[-1] - frames[0] for batch in batches for frames in batch.input_frames]


def test_a_training_widens_the_gap_and_resumes_where_it_was():
    """Two samples a batch, two batches a step: the warm-up of 5 steps ends with sample 20."""
    options = ["view_sampler.warm_up_steps=5", "view_sampler.initial_max_gap=2"]
    recipe = resolve("tiny/tokengs_bounded.yaml", [*options, "data.image_size=[16, 16]"])
    source, sampler = recipe.build_data(), recipe.build_view_sampler()

    def stream(start, count):
        batches = training_batches(source, recipe.views, 2, 0, start, sampler=sampler, accumulate=2)
        return gaps(islice(batches, count))

    whole = stream(0, 14)
    assert stream(9, 5) == whole[18:]
    assert {*whole[:4]} == {2}
    assert max(whole[4:]) > 3
    limits = [sampler.gaps(k // 4) for k in range(28)]
    assert all(low <= gap <= high for gap, (low, high) in zip(whole, limits, strict=True))
    samples = evaluation_samples(source, recipe.views, recipe.evaluation, sampler)
    assert {3, 7} >= {min(found := [s.input_frames[-1] - s.input_frames[0] for s in samples])}
    assert max(found) > 3

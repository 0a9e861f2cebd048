"""The default sampler of views: its draws, and a schedule of its gap."""

from contextlib import nullcontext

import numpy as np
import pytest
from line_scenes import Line

from qgs.components.schedules import Linear
from qgs.composer import RecipeError, resolve
from qgs.contracts import ViewsConfig
from qgs.contracts.schedule import END
from qgs.data.samples import draw_frames
from qgs.data.view_samplers import Span

VIEWS = ViewsConfig(inputs=2, targets=3, gap=(2, 5))


def test_the_default_draws_as_ever():
    for seed in range(50):
        first, second = (np.random.default_rng(seed) for _ in range(2))
        assert Span(Span.Config()).draw(Line(12), VIEWS, first, 0) == draw_frames(
            Line(12), VIEWS, second
        )
        assert first.random() == second.random(), "the generator is where it was"


def test_a_schedule_moves_the_gap_of_the_default():
    sampler = Span(Span.Config(min_gap=2))
    sampler.schedules = {"max_gap": Linear(schedule="linear", values=(2, 10), at=(0, 100))}
    for step, largest in ((0, 2), (50, 6), (100, 10), (END, 10)):
        drawn = [sampler.draw(Line(30), VIEWS, np.random.default_rng(k), step) for k in range(200)]
        assert max(right - left for (left, right), _ in drawn) == largest


@pytest.mark.parametrize(("least", "largest", "wrong"), [(9, 4, True), (4, 9, False)])
def test_a_least_gap_above_the_largest_is_refused(least, largest, wrong):
    with pytest.raises(RecipeError, match=r"view_sampler\.min_gap") if wrong else nullcontext():
        resolve(
            "recipes/tiny/tokengs.yaml",
            [f"view_sampler.min_gap={least}", f"view_sampler.max_gap={largest}"],
        )

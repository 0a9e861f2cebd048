"""The default sampler of views: its draws, and a schedule of its gap."""

import numpy as np
import pytest
from line_scenes import Line
from training_runs import tiny

from qgs.contracts import ViewsConfig
from qgs.contracts.schedule import END
from qgs.data.view_samplers import Span
from qgs.recipe import RecipeError
from qgs.tokengs.schedules import Linear

VIEWS = ViewsConfig(inputs=2, targets=3, gap=(2, 5))


def test_a_schedule_moves_the_gap_of_the_default():
    sampler = Span(Span.Config(min_gap=2))
    sampler.schedules = {"max_gap": Linear(schedule="linear", values=(2, 10), at=(0, 100))}
    for step, largest in ((0, 2), (50, 6), (100, 10), (END, 10)):
        drawn = [sampler.draw(Line(30), VIEWS, np.random.default_rng(k), step) for k in range(200)]
        assert max(right - left for (left, right), _ in drawn) == largest


def test_a_least_gap_above_the_largest_is_refused():
    tiny("tokengs", "view_sampler.min_gap=4", "view_sampler.max_gap=9")
    with pytest.raises(RecipeError, match=r"view_sampler\.min_gap"):
        tiny("tokengs", "view_sampler.min_gap=9", "view_sampler.max_gap=4")

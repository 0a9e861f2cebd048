"""Gradients and options of visibility; golden/test_files.py compares it with the released code."""

import torch
from losses.judging import CAMERAS, GOLDEN

from qgs.contracts import ModelDims, RecipeContext
from qgs.losses import Visibility, view_visibility

POINTS, FIRST = GOLDEN["points"], CAMERAS[:, :1]
BEHIND = [0, 5]


def test_gradients_are_finite_everywhere():
    nearly_zero = torch.tensor([[0.3, 0.1, 1e-30], [1e-30, 0.0, 1e-30], [0.0, 0.2, -1e-12]])
    points = torch.cat([POINTS, nearly_zero.expand(2, 3, 3)], 1).requires_grad_()
    for options in ({}, {"behind": 0.025}, {"clamp": None}, {"z_guard": 1e-3}):
        values = view_visibility(points, FIRST, **options)
        (gradient,) = torch.autograd.grad(values.sum(), points)
        assert values.isfinite().all(), options
        assert gradient.isfinite().all(), options
        assert gradient.any(), options


def test_points_behind_a_camera_are_invisible_on_demand():
    published, corrected = (
        view_visibility(POINTS, FIRST, behind=behind)[0] for behind in (None, 0.025)
    )
    in_front = POINTS[0, :, 2] > 0.025
    assert (published[BEHIND] == 0).all()
    assert (corrected[BEHIND] == 1).all()
    torch.testing.assert_close(corrected[in_front], published[in_front])


def test_options_that_cannot_work_are_refused():
    context = RecipeContext(ModelDims(width=8, heads=1, depth=1))
    for options, expected in (
        ({"near": 0.1}, ["near"]),
        ({"infinite_pixel": 10.0}, ["infinite_pixel"]),
        ({"behind_camera": "invisible", "clamp": None}, ["clamp"]),
        ({"behind_camera": "invisible", "near": 0.1}, []),
    ):
        problems = Visibility.problems(Visibility.Config(**options), context)
        assert [problem.option for problem in problems] == expected, options

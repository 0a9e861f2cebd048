"""Options and gradients of losses; golden/test_files.py compares them with the released code."""

import pytest
import torch
import yaml
from losses.judging import CAMERAS, GOLDEN, PREDICTED, TRUTH, judged
from torch.testing import assert_close

from qgs.contracts import ModelDims, RecipeContext
from qgs.losses import Mask, Photometric, Visibility, view_visibility
from qgs.metrics.images import ssim
from qgs.types import Cameras, Views

VIEWS = Views(TRUTH, CAMERAS)
POINTS = GOLDEN["points"]


def photometric(rgb=PREDICTED, truth=TRUTH, **options):
    cameras = Cameras(CAMERAS.c2w, CAMERAS.intrinsics, truth.shape[-2:])
    return judged(Photometric(Photometric.Config(**options)), Views(truth, cameras), rgb=rgb)


def test_valid_ssim_is_the_metric_of_large_enough_images():
    rgb = PREDICTED.clamp(0, 1)
    found = photometric(rgb, ssim_weight=0.3, padding="valid")["ssim"]
    assert_close(found, 0.3 * (1 - ssim(rgb, TRUTH).mean()) / 2)
    with pytest.raises(ValueError, match="at least 11 pixels a side, got 10 x 24"):
        photometric(rgb[..., :10, :], TRUTH[..., :10, :], padding="valid")


def test_terms_have_weights_and_those_of_weight_zero_are_left_out():
    assert photometric(ssim_weight=0.0).keys() == {"mse"}
    terms = photometric(mse_weight=0.0, l1_weight=0.8)
    assert terms.keys() == {"l1", "ssim"}
    assert_close(terms["l1"], 0.8 * (PREDICTED - TRUTH).abs().mean())


def test_mask_without_masks_is_refused():
    with pytest.raises(ValueError, match="qgs/mask needs views with masks"):
        judged(Mask(Mask.Config()), VIEWS)


def test_gradients_of_visibility_are_finite_everywhere():
    nearly_zero = torch.tensor([[0.3, 0.1, 1e-30], [1e-30, 0.0, 1e-30], [0.0, 0.2, -1e-12]])
    points = torch.cat([POINTS, nearly_zero.expand(2, 3, 3)], 1).requires_grad_()
    for options in ({}, {"behind": 0.025}, {"clamp": None}, {"z_guard": 1e-3}):
        values = view_visibility(points, CAMERAS[:, :1], **options)
        (gradient,) = torch.autograd.grad(values.sum(), points)
        assert values.isfinite().all(), options
        assert gradient.isfinite().all(), options
        assert gradient.any(), options


def test_points_behind_a_camera_are_invisible_on_demand():
    published, corrected = (
        view_visibility(POINTS, CAMERAS[:, :1], behind=behind)[0] for behind in (None, 0.025)
    )
    in_front = POINTS[0, :, 2] > 0.025
    assert (published[[0, 5]] == 0).all()
    assert (corrected[[0, 5]] == 1).all()
    assert_close(corrected[in_front], published[in_front])


OPTIONS = """
- [{near: 0.1}, [near]]
- [{infinite_pixel: 10.0}, [infinite_pixel]]
- [{behind_camera: invisible, clamp: null}, [clamp]]
- [{behind_camera: invisible, near: 0.1}, []]
"""
"""Options of visibility, and those that are refused."""


def test_options_of_visibility_that_cannot_work_are_refused():
    context = RecipeContext(ModelDims(width=8, heads=1, depth=1))
    for options, expected in yaml.safe_load(OPTIONS):
        problems = Visibility.problems(Visibility.Config(**options), context)
        assert [problem.option for problem in problems] == expected

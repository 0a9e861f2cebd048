"""The photometric loss: its options, and finite gradients; golden/test_files.py has the numbers."""

import pytest
import torch
from losses.judging import CAMERAS, PREDICTED, TRUTH, judged
from torch.testing import assert_close

from qgs.losses import Photometric
from qgs.metrics.images import ssim
from qgs.types import Cameras, Views


def terms_of(rgb=PREDICTED, truth=TRUTH, **options):
    cameras = Cameras(CAMERAS.c2w, CAMERAS.intrinsics, truth.shape[-2:])
    return judged(Photometric(Photometric.Config(**options)), Views(truth, cameras), rgb=rgb)


def test_valid_ssim_is_the_metric_of_large_enough_images():
    rgb = PREDICTED.clamp(0, 1)
    found = terms_of(rgb, ssim_weight=0.3, padding="valid")["ssim"]
    assert_close(found, 0.3 * (1 - ssim(rgb, TRUTH).mean()) / 2)
    with pytest.raises(ValueError, match="at least 11 pixels a side, got 10 x 24"):
        terms_of(rgb[..., :10, :], TRUTH[..., :10, :], padding="valid")


def test_flat_images_have_finite_gradients():
    shades = torch.tensor([0.0, 0.5, 1.0])[None, :, None, None, None]
    rgb = shades.expand(TRUTH.shape).clone().requires_grad_()
    total = sum(terms_of(rgb, torch.full_like(TRUTH, 0.5)).values())
    assert torch.autograd.grad(total, rgb)[0].isfinite().all()


def test_terms_have_weights_and_those_of_weight_zero_are_left_out():
    assert terms_of(ssim_weight=0.0).keys() == {"mse"}
    terms = terms_of(mse_weight=0.0, l1_weight=0.8)
    assert terms.keys() == {"l1", "ssim"}
    assert_close(terms["l1"], 0.8 * (PREDICTED - TRUTH).abs().mean())

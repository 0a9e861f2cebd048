"""The mask and opacity losses; golden/test_files.py compares them with the released code."""

import pytest
import torch
from losses.judging import CAMERAS, GOLDEN, TRUTH, judged

from qgs.losses import Mask, Opacity
from qgs.types import Views

VIEWS = Views(TRUTH, CAMERAS)


def test_mask_without_masks_is_refused():
    with pytest.raises(ValueError, match="qgs/mask needs views with masks"):
        judged(Mask(Mask.Config()), VIEWS)


def test_vanished_gaussians_have_a_finite_opacity_loss():
    opacities = torch.zeros(2, 40, requires_grad=True)
    found = judged(Opacity(Opacity.Config()), VIEWS, GOLDEN["points"], opacities)["opacity"]
    (gradient,) = torch.autograd.grad(found, opacities)
    assert found.isfinite()
    assert gradient.isfinite().all()
    assert (gradient < 0).all()

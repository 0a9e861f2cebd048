"""The mask and opacity losses against the released code."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from qgs.contracts import Loss
from qgs.losses import Mask, Opacity
from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering, Views

TOLERANCE = {"rtol": 1e-4, "atol": 5e-5}


def views_of(golden: dict[str, Tensor]) -> Views:
    cameras = Cameras(golden["c2w"], golden["intrinsics"], (16, 24))
    return Views(golden["images_gt"], cameras, golden["masks_gt"])


def term_of(loss: Loss, golden: dict[str, Tensor], target: Views) -> dict[str, Tensor]:
    means, alpha = golden["points"], golden["alphas_pred"]
    quats = torch.ones(*means.shape[:2], 4)
    gaussians = Gaussians(means, means.abs(), quats, golden["opacity"][..., 0], means.sigmoid())
    rendering = Rendering(golden["images_pred"], alpha, alpha)
    return loss(LayerPrediction(gaussians, QueryState(means)), rendering, target, target)


def test_mask_is_the_released_one(golden: dict[str, Tensor]) -> None:
    first = {key: tensor[:1] for key, tensor in golden.items() if tensor.ndim}
    terms = term_of(Mask(Mask.Config(weight=2.0)), first, views_of(first))
    expected = 2.0 * golden["expected.tokengs.nossim.loss_mask_per_scene"][0]
    torch.testing.assert_close(terms, {"mask": expected}, **TOLERANCE)


def test_mask_without_masks_is_refused(golden: dict[str, Tensor]) -> None:
    with pytest.raises(ValueError, match="qgs/mask needs views with masks"):
        term_of(Mask(Mask.Config()), golden, replace(views_of(golden), masks=None))


def test_opacity_is_the_released_one_to_the_last_digit(golden: dict[str, Tensor]) -> None:
    terms = term_of(Opacity(Opacity.Config(weight=1.0)), golden, views_of(golden))
    expected = golden["expected.tokengs.nossim.loss_opacity"]
    torch.testing.assert_close(terms, {"opacity": expected}, rtol=1e-7, atol=0)


def test_vanished_gaussians_have_a_finite_opacity_loss(golden: dict[str, Tensor]) -> None:
    opacity = torch.zeros_like(golden["opacity"]).requires_grad_()
    terms = term_of(Opacity(Opacity.Config()), {**golden, "opacity": opacity}, views_of(golden))
    (gradient,) = torch.autograd.grad(terms["opacity"], opacity)
    assert terms["opacity"].isfinite()
    assert gradient.isfinite().all()
    assert (gradient < 0).all()

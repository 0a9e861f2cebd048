"""The photometric loss: its options, and finite gradients; golden/test_files.py has the numbers."""

import pytest
import torch
from torch import Tensor

from qgs.losses import Photometric
from qgs.metrics.images import ssim
from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering, Views


def terms_of(rgb: Tensor, truth: Tensor, **options: object) -> dict[str, Tensor]:
    batch, views, _, height, width = truth.shape
    cameras = Cameras(
        torch.eye(4).repeat(batch, views, 1, 1), torch.ones(batch, views, 4), (height, width)
    )
    alpha = torch.ones_like(rgb[:, :, :1])
    nothing, quats = torch.zeros(batch, 0, 3), torch.zeros(batch, 0, 4)
    gaussians = Gaussians(nothing, nothing, quats, torch.zeros(batch, 0), nothing)
    loss = Photometric(Photometric.Config(**options))
    prediction = LayerPrediction(gaussians, QueryState(nothing))
    views = Views(truth, cameras)
    return loss(prediction, Rendering(rgb, alpha, alpha), views, views)


def test_valid_ssim_is_the_metric(golden: dict[str, Tensor]) -> None:
    rgb, truth = golden["images_pred"].clamp(0, 1), golden["images_gt"]
    terms = terms_of(rgb, truth, ssim_weight=0.3, padding="valid")
    torch.testing.assert_close(terms["ssim"], 0.3 * (1 - ssim(rgb, truth).mean()) / 2)


@pytest.mark.parametrize("padding", ["same", "valid"])
def test_perfect_images_cost_nothing_and_pull_nowhere(padding: str) -> None:
    truth = torch.rand(1, 2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    rgb = truth.clone().requires_grad_()
    total = sum(terms_of(rgb, truth, padding=padding).values())
    (gradient,) = torch.autograd.grad(total, rgb)
    assert abs(float(total.detach())) < 1e-6
    assert float(gradient.abs().max()) < 1e-5


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_flat_images_have_finite_gradients(value: float) -> None:
    rgb = torch.full((1, 1, 3, 16, 16), value, requires_grad=True)
    truth = torch.full((1, 1, 3, 16, 16), 0.5)
    (gradient,) = torch.autograd.grad(sum(terms_of(rgb, truth).values()), rgb)
    assert gradient.isfinite().all()


def test_a_term_of_weight_zero_is_left_out(golden: dict[str, Tensor]) -> None:
    rgb, truth = golden["images_pred"], golden["images_gt"]
    assert set(terms_of(rgb, truth, ssim_weight=0.0)) == {"mse"}
    assert set(terms_of(rgb, truth, mse_weight=0.0)) == {"ssim"}


def test_l1_is_the_mean_absolute_error(golden: dict[str, Tensor]) -> None:
    rgb, truth = golden["images_pred"], golden["images_gt"]
    terms = terms_of(rgb, truth, mse_weight=0.0, l1_weight=0.8)
    assert set(terms) == {"l1", "ssim"}
    torch.testing.assert_close(terms["l1"], 0.8 * (rgb - truth).abs().mean())


def test_images_smaller_than_a_valid_window_are_refused() -> None:
    images = torch.rand(1, 1, 3, 10, 16)
    with pytest.raises(ValueError, match="at least 11 pixels a side, got 10 x 16"):
        terms_of(images, images, padding="valid")

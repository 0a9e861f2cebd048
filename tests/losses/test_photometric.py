"""The photometric loss: published MSE, SSIM as documented, finite gradients."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from qgs.losses import Photometric
from qgs.losses.visibility import view_visibility
from qgs.metrics.images import psnr, ssim
from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering, Views

GOLDEN = Path(__file__).parents[1] / "golden" / "loss_a.safetensors"
TOLERANCE = {"rtol": 1e-4, "atol": 5e-5}


@pytest.fixture(scope="module")
def golden() -> dict[str, Tensor]:
    return load_file(GOLDEN)


@pytest.fixture(scope="module")
def truth(golden: dict[str, Tensor]) -> Tensor:
    """Ground truth on white outside of its mask, as the released code compares with it."""
    mask = golden["masks_gt"]
    return golden["images_gt"] * mask + (1 - mask)


def terms_of(rgb: Tensor, truth: Tensor, **options: object) -> dict[str, Tensor]:
    batch, views, _, height, width = truth.shape
    cameras = Cameras(
        torch.eye(4).repeat(batch, views, 1, 1), torch.ones(batch, views, 4), (height, width)
    )
    alpha = torch.ones_like(rgb[:, :, :1])
    nothing = torch.zeros(batch, 0, 3)
    gaussians = Gaussians(
        nothing, nothing, torch.zeros(batch, 0, 4), torch.zeros(batch, 0), nothing
    )
    loss = Photometric(Photometric.Config(**options))
    prediction = LayerPrediction(gaussians, QueryState(nothing))
    return loss(prediction, Rendering(rgb, alpha, alpha), Views(truth, cameras))


def test_mse_of_the_released_code(golden: dict[str, Tensor], truth: Tensor) -> None:
    rgb = golden["images_pred"]
    mse = terms_of(rgb, truth)["mse"]
    torch.testing.assert_close(mse, golden["expected.locusgs.nossim.loss_mse"], **TOLERANCE)
    torch.testing.assert_close(mse, golden["expected.tokengs.nossim.loss_rgb"], **TOLERANCE)
    for scene in range(2):
        alone = terms_of(rgb[scene : scene + 1], truth[scene : scene + 1])["mse"]
        expected = golden["expected.locusgs.nossim.loss_mse_per_scene"][scene]
        torch.testing.assert_close(alone, expected, **TOLERANCE)


def test_the_whole_published_loss_but_its_mask_terms(
    golden: dict[str, Tensor], truth: Tensor
) -> None:
    cameras = Cameras(golden["c2w"], golden["intrinsics"], (16, 24))
    mse = terms_of(golden["images_pred"], truth, ssim_weight=0.0)["mse"]
    visibility = view_visibility(golden["points"], cameras).mean()
    opacity = 0.1 * golden["expected.tokengs.nossim.loss_opacity"]
    mask = 0.5 * golden["expected.locusgs.nossim.loss_mask"]
    expected = golden["expected.locusgs.nossim.loss"]
    torch.testing.assert_close(mse + visibility + mask, expected, **TOLERANCE)
    expected = golden["expected.tokengs.nossim.loss"]
    torch.testing.assert_close(mse + visibility + mask + opacity, expected, **TOLERANCE)


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


def test_the_ssim_term_of_the_golden_file(golden: dict[str, Tensor], truth: Tensor) -> None:
    rgb = golden["images_pred"]
    ssim_term = terms_of(rgb, truth, ssim_weight=1.0)["ssim"]
    torch.testing.assert_close(ssim_term, golden["expected.locusgs.refssim.loss_ssim"], **TOLERANCE)
    torch.testing.assert_close(ssim_term, golden["expected.tokengs.refssim.loss_ssim"], **TOLERANCE)
    for scene in range(2):
        alone = terms_of(rgb[scene : scene + 1], truth[scene : scene + 1], ssim_weight=1.0)["ssim"]
        expected = golden["expected.locusgs.refssim.loss_ssim_per_scene"][scene]
        torch.testing.assert_close(alone, expected, **TOLERANCE)


def test_images_smaller_than_a_valid_window_are_refused() -> None:
    images = torch.rand(1, 1, 3, 10, 16)
    with pytest.raises(ValueError, match="at least 11 pixels a side, got 10 x 16"):
        terms_of(images, images, padding="valid")


def test_published_psnr_is_the_mean_over_views(golden: dict[str, Tensor], truth: Tensor) -> None:
    per_scene = psnr(golden["images_pred"], truth).mean(1)
    expected = golden["expected.locusgs.nossim.psnr_per_scene"]
    torch.testing.assert_close(per_scene, expected, **TOLERANCE)

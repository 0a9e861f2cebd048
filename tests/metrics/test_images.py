"""PSNR by its formula, SSIM against scikit-image."""

import pytest
import torch
from skimage.metrics import structural_similarity
from torch.testing import assert_close

from qgs.metrics.images import psnr, ssim


def pair(noise, size=(24, 37)):
    coarse = torch.rand(2, 3, 6, 8)
    truth = torch.nn.functional.interpolate(coarse, size, mode="bilinear")
    return truth + noise * torch.randn(truth.shape), truth


def test_ssim_equals_scikit_image():
    sizes = ((11, 11), (11, 40), (13, 17), (64, 33))
    options = {"channel_axis": 0, "data_range": 1.0, "gaussian_weights": True, "sigma": 1.5}
    for covariance in ("population", "sample"):
        options["use_sample_covariance"] = covariance == "sample"
        for images, truth in (*map(pair, (0.02, 0.2, 1.0)), *(pair(0.1, size) for size in sizes)):
            expected = [
                structural_similarity(a.clamp(0, 1).double().numpy(), b.double().numpy(), **options)
                for a, b in zip(images, truth, strict=True)
            ]
            found = ssim(images, truth, covariance).double()
            assert_close(found, torch.tensor(expected), rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="at least 11 pixels a side, got 10 x 20"):
        ssim(*pair(0.1, (10, 20)))


def test_psnr_is_that_of_clipped_images():
    for noise in (0.02, 1.0):
        images, truth = pair(noise)
        errors = (images.clamp(0, 1) - truth).square().mean((1, 2, 3))
        assert_close(psnr(images, truth), -10 * errors.log10())


def test_identical_images_with_leading_dimensions():
    truth = pair(0.0)[1][:, None].expand(-1, 4, -1, -1, -1)
    assert_close(ssim(truth, truth), torch.ones(2, 4))
    assert_close(psnr(truth, truth), torch.full((2, 4), 100.0))

"""PSNR and SSIM as papers report them (LocusGS evaluation)."""

from __future__ import annotations

from kornia.metrics import ssim as kornia_ssim
from torch import Tensor

from qgs.geometry.precision import full_precision

_WINDOW = 11
_MSE_FLOOR = 1e-10
"""Identical images get 100 dB."""

IMAGE_METRICS = {
    "psnr": "dB of images clipped to [0, 1], mean over views, then over scenes",
    "ssim": "scikit-image: Gaussian window of 11, sigma 1.5, data range 1, borders left out",
    "lpips": "VGG-16, version 0.1, images in [-1, 1]",
}
"""What each metric is, in words that are part of an evaluation protocol."""


@full_precision
def psnr(images: Tensor, truth: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB of images (..., 3, H, W), clipped to [0, 1] -> (...)."""
    error = (images.clamp(0, 1) - truth.clamp(0, 1)).square().mean((-3, -2, -1))
    return -10 * error.clamp_min(_MSE_FLOOR).log10()


@full_precision
def ssim(images: Tensor, truth: Tensor) -> Tensor:
    """Structural similarity of images (..., 3, H, W), clipped to [0, 1] -> (...).

    Equals scikit-image's `structural_similarity` with gaussian_weights, sigma 1.5, data_range 1
    and use_sample_covariance=False, which leaves out the 5 pixels at the border. Computed in
    float64: the variances of flat images are small differences of squares.
    Raises ValueError when a side is shorter than the window of 11 pixels.
    """
    if min(images.shape[-2:]) < _WINDOW:
        raise ValueError(
            f"SSIM needs images of at least {_WINDOW} pixels a side, got "
            f"{images.shape[-2]}x{images.shape[-1]}"
        )
    flat = [x.clamp(0, 1).double().reshape(-1, *x.shape[-3:]) for x in (images, truth)]
    similarity = kornia_ssim(*flat, window_size=_WINDOW, padding="valid", eps=0.0)
    return similarity.mean((-3, -2, -1)).reshape(images.shape[:-3]).to(images.dtype)

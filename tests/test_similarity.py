"""SSIM and its gradient against windows written out in float64, by the kernel and by torch."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.similarity import Padding, mean_ssim, similarity_map

SIZES = [(1, 1), (3, 7), (11, 11), (16, 40), (33, 12)]


def pair(*shape: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(shape, generator=generator)
    return (truth + 0.2 * torch.randn(shape, generator=generator)).requires_grad_(), truth


def slow(x: Tensor, y: Tensor, padding: Padding) -> Tensor:
    """Equation 13 of Wang et al. 2004, every window of 11 x 11 pixels copied out."""
    offset = torch.arange(-5.0, 6.0, dtype=torch.float64)
    weights = torch.exp(-(offset[:, None] ** 2 + offset**2) / (2 * 1.5**2)).flatten()
    border = 5 if padding == "same" else 0

    def mean(image: Tensor) -> Tensor:
        planes = image.reshape(-1, 1, *image.shape[-2:])
        windows = F.unfold(planes, 11, padding=border)
        return (weights / weights.sum() * windows.mT).sum(-1)

    a, b = mean(x), mean(y)
    variances, covariance = mean(x * x) - a * a + mean(y * y) - b * b, mean(x * y) - a * b
    first = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    return (first * (2 * covariance + 9e-4) / (variances + 9e-4)).mean()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("padding", ["same", "valid"])
def test_values_and_gradients(size: tuple[int, int], dtype: torch.dtype, padding: Padding) -> None:
    if padding == "valid" and min(size) < 11:
        pytest.skip("smaller than a window")
    images, truth = pair(2, 3, *size)
    found = mean_ssim(images.to(dtype), truth.to(dtype), padding)
    expected = slow(images.double(), truth.double(), padding)
    exact = dtype == torch.float64
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1e-12 if exact else 2e-7)
    slope, reference = (torch.autograd.grad(3 * value, images)[0] for value in (found, expected))
    assert (slope - reference).abs().max() <= 3e-6 * reference.abs().max()


def test_any_leading_dimensions_and_strides() -> None:
    images, truth = pair(2, 3, 20, 14)
    expected = mean_ssim(images, truth, "same")
    torch.testing.assert_close(mean_ssim(images.mT, truth.mT, "same"), expected)
    one = truth[:1, :1].expand(2, 3, -1, -1)
    torch.testing.assert_close(
        mean_ssim(images, one, "same"), mean_ssim(images, one.clone(), "same"), rtol=0, atol=0
    )
    torch.testing.assert_close(
        mean_ssim(images[0, 0], truth[0, 0], "same"),
        similarity_map(images[0, 0], truth[0, 0], "same").mean(),
    )


def test_the_same_bits_whatever_the_threads() -> None:
    images, truth = pair(1, 5, 3, 70, 90)
    found, before = [], torch.get_num_threads()
    for count in (1, 3):
        torch.set_num_threads(count)
        value = mean_ssim(images, truth, "same")
        found.append((value, *torch.autograd.grad(value, images)))
    torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_a_gradient_by_the_truth_too() -> None:
    images, truth = pair(1, 3, 12, 15)
    value = mean_ssim(truth, images, "same")
    expected = slow(truth.double(), images.double(), "same")
    slopes = [torch.autograd.grad(v, images)[0] for v in (value, expected)]
    torch.testing.assert_close(*slopes, rtol=1e-4, atol=1e-8)

"""SSIM and its gradient against windows written out in float64, by the kernel and by torch."""

from itertools import product

import torch
import torch.nn.functional as F
from tables import assert_equal

from qgs.similarity import mean_ssim


def pair(*shape):
    truth = torch.rand(shape)
    return (truth + 0.2 * torch.randn(shape)).requires_grad_(), truth


def slow(x, y):
    """Equation 13 of Wang et al. 2004, every window of 11 x 11 pixels at once, in float64."""
    offset = torch.arange(-5.0, 6.0).double()
    weights = torch.exp(-(offset[:, None] ** 2 + offset**2) / (2 * 1.5**2))
    window = (weights / weights.sum())[None, None]
    x = x.double()
    y = y.double()

    def mean(image):
        return F.conv2d(image.reshape(-1, 1, *image.shape[-2:]), window, padding="same")

    a = mean(x)
    b = mean(y)
    variances = mean(x * x) - a * a + mean(y * y) - b * b
    covariance = mean(x * y) - a * b
    first = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    return (first * (2 * covariance + 9e-4) / (variances + 9e-4)).mean()


def test_values_and_gradients():
    """Of either image, which goes another way, of any leading dimensions and strides."""
    sizes = [(1, 1), (3, 7), (11, 11), (16, 40), (33, 12)]
    for size, dtype in product(sizes, [torch.float32, torch.float64]):
        images, truth = pair(2, 3, *size)
        one = truth[:1, :1].mT.expand(2, 3, -1, -1)
        for x, y in (
            (images, truth),
            (truth, images),
            (images.mT, one),
            (images[0, 0], truth[0, 0]),
        ):
            found = mean_ssim(x.to(dtype), y.to(dtype), "same")
            expected = slow(x, y)
            slope, reference = (torch.autograd.grad(3 * v, images)[0] for v in (found, expected))
            off = (slope - reference).abs().max() / reference.abs().max()
            assert (found - expected).abs() <= (2e-7 if dtype == torch.float32 else 1e-12)
            assert off <= 3e-6, (size, dtype)


def test_the_same_bits_whatever_the_threads():
    images, truth = pair(1, 5, 3, 70, 90)
    found = []
    for count in (3, 1):
        torch.set_num_threads(count)
        value = mean_ssim(images, truth, "same")
        found.append((value, *torch.autograd.grad(value, images)))
    assert_equal(*found)

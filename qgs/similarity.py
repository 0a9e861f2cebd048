"""SSIM, the structural similarity of images (Wang et al. 2004), as a map and as a mean."""

from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.machine import in_threads
from qgs.precision import full_precision

WINDOW = 11
_BELL = np.exp(-0.5 * (np.arange(-(WINDOW // 2), WINDOW // 2 + 1) / 1.5) ** 2)
_WEIGHTS = torch.from_numpy(_BELL / _BELL.sum())
# for a data range of 1
_C1 = 0.01**2
_C2 = 0.03**2

Padding = Literal["same", "valid"]


def similarity_map(x: Tensor, y: Tensor, padding: Padding, correction: float = 1.0) -> Tensor:
    """Return the SSIM (Wang et al. 2004, eq. 13) of x and y in a window around every pixel.

    The window is Gaussian. x, y: images (..., H, W) in [0, 1].
    padding: "same" pads with zeros, as the TokenGS and LocusGS releases do. "valid" uses only
        windows inside the image, and raises ValueError for images smaller than a window.
    correction: factor by which variances and covariance are multiplied.
    """
    height, width = x.shape[-2:]
    if padding == "valid" and min(height, width) < WINDOW:
        size = f"at least {WINDOW} pixels a side, got {height} x {width}"
        raise ValueError(f"SSIM without padding needs images of {size}: raise data.image_size")
    moments = torch.stack([x, y, x * x + y * y, x * y])
    planes = moments.reshape(1, -1, height, width)
    edge = WINDOW // 2 if padding == "same" else 0
    # One group per plane: on a CPU this takes a tenth of the time of a batch of planes.
    groups = planes.shape[1]
    kernel = _WEIGHTS.to(planes).expand(groups, 1, 1, -1)
    planes = F.conv2d(planes, kernel, padding=(0, edge), groups=groups)
    planes = F.conv2d(planes, kernel.mT, padding=(edge, 0), groups=groups)
    mean_x, mean_y, squares, product = planes.view(*moments.shape[:-2], *planes.shape[-2:])
    energy = mean_x.square() + mean_y.square()
    # Variances from differences of squares lose digits, so callers use float32 or better.
    similarity = (2 * mean_x * mean_y + _C1) * (2 * correction * (product - mean_x * mean_y) + _C2)
    return similarity / ((energy + _C1) * (correction * (squares - energy) + _C2))


@full_precision
def mean_ssim(images: Tensor, truth: Tensor, padding: Padding) -> Tensor:
    """Return the mean of `similarity_map`, 0-d; most calls on a CPU use a faster kernel."""
    # Subclasses that torch uses to count or trace hold no numbers and cannot become arrays.
    plain = type(images) is type(truth) is Tensor and images.is_cpu
    single = images.dtype == truth.dtype == torch.float32
    if plain and single and padding == "same" and not truth.requires_grad:
        return _Mean.apply(images, truth)
    return similarity_map(images, truth, padding).mean()


class _Mean(torch.autograd.Function):
    """Mean SSIM of images and truth (..., H, W) with zero padding, computed by a CPU kernel."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, truth: Tensor) -> Tensor:
        from qgs.kernels.similarity import similarity_sum

        x, y = (t.detach().reshape(-1, *t.shape[-2:]).numpy() for t in (images, truth))
        moments = np.stack([x, y, x * x + y * y, x * y], 1)
        sums = np.empty(len(x))
        slopes = np.empty_like(x, order="C")
        options = _WEIGHTS[WINDOW // 2 :].float().numpy(), (np.float32(_C1), np.float32(_C2))

        def measure(plane: int) -> None:
            sums[plane] = similarity_sum(moments[plane], *options, slopes[plane])

        in_threads(measure, ((plane,) for plane in range(len(x))))
        ctx.save_for_backward(torch.from_numpy(slopes).view(images.shape) / x.size)
        return images.new_tensor(sums.sum() / x.size)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *given: Tensor) -> tuple[Tensor | None, ...]:
        return given[0] * ctx.saved_tensors[0], None

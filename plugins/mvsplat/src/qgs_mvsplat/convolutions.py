"""Small parts of convolutional networks that several files share."""

from collections.abc import Sequence
from typing import Literal, TypeAlias

import torch.nn.functional as F
from torch import Tensor, nn

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

Padding: TypeAlias = Literal["zeros", "replicate"]


def imagenet_normalized(images_BV3HW: Tensor) -> Tensor:
    """Images in [0, 1] with the mean and the deviation of ImageNet's taken off."""
    mean, std = (images_BV3HW.new_tensor(x)[:, None, None] for x in (IMAGENET_MEAN, IMAGENET_STD))
    return (images_BV3HW - mean) / std


def conv3(inputs: int, outputs: int, padding: Padding = "zeros") -> nn.Conv2d:
    """A 3x3 convolution that keeps height and width."""
    return nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode=padding)


def two_convolutions(
    inputs: int, hidden: int, outputs: int, padding: Padding = "zeros"
) -> nn.Sequential:
    """3x3 convolution, GELU, 3x3 convolution."""
    return nn.Sequential(conv3(inputs, hidden, padding), nn.GELU(), conv3(hidden, outputs, padding))


def zeroed(module: nn.Module) -> nn.Module:
    """`module` with parameters that start at zero, so that what it adds is nothing at first."""
    for parameter in module.parameters():
        nn.init.zeros_(parameter)
    return module


def resized(x_BCHW: Tensor, size: Sequence[int]) -> Tensor:
    """Bilinear, with the centres of the corner pixels in the same places (align_corners)."""
    return F.interpolate(x_BCHW, tuple(size), mode="bilinear", align_corners=True)

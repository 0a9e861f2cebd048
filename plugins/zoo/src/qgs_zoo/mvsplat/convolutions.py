"""Small parts of convolutional networks that several files share."""

from collections.abc import Sequence
from typing import Literal, TypeAlias

import torch.nn.functional as F
from torch import Tensor, nn

Padding: TypeAlias = Literal["zeros", "replicate"]


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

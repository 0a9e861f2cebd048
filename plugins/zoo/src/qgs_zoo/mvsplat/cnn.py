"""CNN from images to feature maps at 1/4 or 1/8 of the image size (GMFlow, UniMatch).

The multi-view transformer reads these maps.
"""

from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor, nn

from qgs_zoo.mvsplat.unet import conv3

WIDTHS = (64, 96, 128)
"""Channels of the three stages of the CNN (released code)."""


class Stages(NamedTuple):
    """Feature maps of the CNN's first two stages, and a 1 x 1 convolution of the third map."""

    first: Tensor
    second: Tensor
    features: Tensor


class ResidualBlock(nn.Module):
    """Residual block relu(skip(x) + relu(norm(conv(relu(norm(conv x)))))).

    It maps (N, C, H, W) to (N, C', H/s, W/s), with s the stride and C' = `outputs`.
    """

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = conv3(inputs, outputs, stride=stride, bias=False)
        self.conv2 = conv3(outputs, outputs, bias=False)
        self.stride = stride
        same = stride == 1 and inputs == outputs
        self.downsample = None if same else nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride))

    def forward(self, x_NCHW: Tensor) -> Tensor:
        skip_NCHW = x_NCHW
        if self.downsample is not None:
            weight, bias = self.downsample.parameters()
            # Published files have this bias, but the norm removes it. Times zero it learns nothing;
            # otherwise it would learn from rounding errors.
            skip_NCHW = F.instance_norm(F.conv2d(x_NCHW, weight, 0 * bias, self.stride))
        x_NCHW = F.relu(F.instance_norm(self.conv1(x_NCHW)))
        # The branch has a ReLU before the sum too (released code).
        return F.relu(skip_NCHW + F.relu(F.instance_norm(self.conv2(x_NCHW))))


class CNN(nn.Module):
    """CNN: 7 x 7 convolution to half size, three stages of two residual blocks, 1 x 1 convolution.

    width: channels of the last convolution. strides: strides of stages two and three. widths:
    channels of the three stages. Instance norms have neither parameters nor running statistics, so
    the CNN computes the same in training and evaluation.
    """

    def __init__(self, width: int, strides: tuple[int, int], widths: tuple[int, int, int]) -> None:
        super().__init__()
        first, second, third = widths
        self.conv1 = nn.Conv2d(3, first, 7, 2, padding=3, bias=False)
        self.layer1 = _stage(first, first, 1)
        self.layer2 = _stage(first, second, strides[0])
        self.layer3 = _stage(second, third, strides[1])
        self.conv2 = nn.Conv2d(third, width, 1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, images_N3HW: Tensor) -> Stages:
        """Return the feature maps of N images.

        images: normalised by ImageNet's mean and standard deviation.
        """
        # All stages are returned: the upsamplers take the finer ones.
        first = self.layer1(F.relu(F.instance_norm(self.conv1(images_N3HW))))
        second = self.layer2(first)
        return Stages(first, second, self.conv2(self.layer3(second)))


def _stage(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(ResidualBlock(inputs, outputs, stride), ResidualBlock(outputs, outputs, 1))

"""Small convolutional networks, and a U-Net with attention over the pixels of all views.

The U-Net is the one of latent diffusion, without the embedding of time.
"""

from collections import OrderedDict
from functools import partial
from typing import Literal

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

HEAD_WIDTH = 32

conv3 = partial(nn.Conv2d, kernel_size=3, padding=1)
"""Function that makes a 3 x 3 convolution, which keeps height and width at a stride of 1."""
resized = partial(F.interpolate, mode="bilinear", align_corners=True)
"""Function that resizes maps (N, C, h, w) bilinearly to a size (H, W)."""
group_norm = partial(nn.GroupNorm, 8)
"""Function that makes a GroupNorm with 8 groups for a width that is a multiple of 8."""


def two_convolutions(
    inputs: int, hidden: int, outputs: int, padding: Literal["zeros", "replicate"] = "zeros"
) -> nn.Sequential:
    """Make a sequence of a 3 x 3 convolution, a GELU and a 3 x 3 convolution."""
    first = conv3(inputs, hidden, padding_mode=padding)
    return nn.Sequential(first, nn.GELU(), conv3(hidden, outputs, padding_mode=padding))


def zeroed(module: nn.Module) -> nn.Module:
    """Return `module` with all parameters set to zero, so that it returns 0 before training."""
    for parameter in module.parameters():
        nn.init.zeros_(parameter)
    return module


class OverViews(nn.Sequential):
    """Sequence of modules that passes the number of views to those modules that need it."""

    def forward(self, x_NCHW: Tensor, views: int) -> Tensor:
        for module in self:
            takes_views = isinstance(module, ViewAttention | UNet)
            x_NCHW = module(x_NCHW, views) if takes_views else module(x_NCHW)
        return x_NCHW


def with_norm(inputs: int, outputs: int, pre_norm: bool) -> list[nn.Module]:
    """Make a 3 x 3 convolution, a norm and a SiLU. pre_norm: True puts the convolution last."""
    convolution = conv3(inputs, outputs)
    if pre_norm:
        return [group_norm(inputs), nn.SiLU(), convolution]
    return [convolution, group_norm(outputs), nn.SiLU()]


class ResidualBlock(nn.Module):
    """Residual block of two convolutions, which starts as its skip connection.

    pre_norm: True puts a norm before each convolution, False after each convolution.
    """

    def __init__(self, inputs: int, outputs: int, pre_norm: bool) -> None:
        super().__init__()
        self.in_layers = nn.Sequential(*with_norm(inputs, outputs, pre_norm))
        last = with_norm(outputs, outputs, pre_norm)
        zeroed(last[2 if pre_norm else 1])
        if pre_norm:
            # The identity replaces a dropout of 0 of the release, so that parameter names match.
            last.insert(2, nn.Identity())
        self.out_layers = nn.Sequential(*last)
        same = inputs == outputs
        self.skip_connection = nn.Identity() if same else nn.Conv2d(inputs, outputs, 1)

    def forward(self, x_NCHW: Tensor) -> Tensor:
        return self.skip_connection(x_NCHW) + self.out_layers(self.in_layers(x_NCHW))


class ViewAttention(nn.Module):
    """Self-attention over the pixels of all views, with heads of 32 channels.

    Positions of pixels are not embedded.
    """

    def __init__(self, width: int, pre_norm: bool) -> None:
        super().__init__()
        self.pre_norm = pre_norm
        self.norm = group_norm(width)
        self.qkv = nn.Conv1d(width, 3 * width, 1)
        self.proj_out = nn.Conv1d(width, width, 1)
        zeroed(self.proj_out if pre_norm else self.norm)

    def forward(self, x_NCHW: Tensor, views: int) -> Tensor:
        """Return maps (B V, C, H, W). Each map attends to all V = `views` maps of its scene."""
        x_NCT = x_NCHW.flatten(2)
        raw_NCT = self.qkv(self.norm(x_NCT) if self.pre_norm else x_NCT)
        # Rows of `qkv` are ordered head by head: q, k, v of the first head, then of the second ...
        pattern = "(b v) (h three d) t -> three b h (v t) d"
        q, k, v = rearrange(raw_NCT, pattern, v=views, three=3, d=HEAD_WIDTH)
        read = F.scaled_dot_product_attention(q, k, v)
        out_NCT = self.proj_out(rearrange(read, "b h (v t) d -> (b v) (h d) t", v=views))
        out_NCT = out_NCT if self.pre_norm else self.norm(out_NCT)
        return x_NCHW + out_NCT.view_as(x_NCHW)


class UNet(nn.Module):
    """U-Net with one residual block per level on the way down and two on the way up.

    The U-Net maps (B V, C, H, W) to the same shape. On the lowest level, an attention layer follows
    each of these blocks. H and W must be multiples of 2 ** (levels - 1).
    """

    def __init__(self, width: int, levels: int, pre_norm: bool) -> None:
        super().__init__()

        def block(inputs: int, lowest: bool) -> list[nn.Module]:
            attention = [ViewAttention(width, pre_norm)] if lowest else []
            return [ResidualBlock(inputs, width, pre_norm), *attention]

        down: list[list[nn.Module]] = [[conv3(width, width)]]
        up: list[list[nn.Module]] = []
        for _ in range(levels - 1):
            down.append(block(width, lowest=False))
            down.append([nn.Sequential(OrderedDict(op=conv3(width, width, stride=2)))])
        down.append(block(width, lowest=True))
        for level in reversed(range(levels)):
            up += [block(2 * width, lowest=level == levels - 1) for _ in range(2)]
            finer = nn.Sequential(nn.Upsample(scale_factor=2))
            finer.add_module("conv", conv3(width, width))
            up[-1] += [finer] if level else []
        self.input_blocks = nn.ModuleList(OverViews(*modules) for modules in down)
        first = ResidualBlock(width, width, pre_norm)
        second = ResidualBlock(width, width, pre_norm)
        # the identity keeps the number of the second block, so that parameter names match
        self.middle_block = nn.Sequential(first, nn.Identity(), second)
        self.output_blocks = nn.ModuleList(OverViews(*modules) for modules in up)
        self.out = nn.Sequential(*with_norm(width, width, pre_norm))
        if pre_norm:
            zeroed(self.out[2])

    def forward(self, x_NCHW: Tensor, views: int) -> Tensor:
        """Return maps with the shape of `x_NCHW`: `views` maps of each scene, scene by scene."""
        skips = []
        for module in self.input_blocks:
            x_NCHW = module(x_NCHW, views)
            skips.append(x_NCHW)
        x_NCHW = self.middle_block(x_NCHW)
        for module in self.output_blocks:
            x_NCHW = module(torch.cat([x_NCHW, skips.pop()], 1), views)
        return self.out(x_NCHW)

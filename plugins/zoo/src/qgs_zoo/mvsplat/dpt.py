"""DPT heads (Ranftl et al., arXiv 2103.13413) of DepthSplat: a ViT's tokens to full-size maps.

Four maps of a ViT become four resolutions, 1/2 to 1/16; other features join them at 1/2, 1/4 and
1/8; the coarse ones are added to the fine ones step by step.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from qgs_zoo.mvsplat.unet import resized, two_convolutions, zeroed

LEVELS = 3
"""Resolutions at which other features join: 1/2, 1/4, 1/8."""


class ResidualUnit(nn.Module):
    """x + conv(relu(conv(relu x))), 3 x 3: (X, F, h, w) -> (X, F, h, w)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x_XFhw: Tensor) -> Tensor:
        return x_XFhw + self.conv2(self.conv1(x_XFhw.relu()).relu())


class Fusion(nn.Module):
    """Adds a map to the coarser ones so far and brings their sum to the next size."""

    def __init__(self, channels: int, coarsest: bool) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(channels, channels, 1)
        self.resConfUnit1 = None if coarsest else ResidualUnit(channels)
        self.resConfUnit2 = ResidualUnit(channels)

    def forward(self, coarse: Tensor | None, skip: Tensor, size: Sequence[int]) -> Tensor:
        """coarse: None for the coarsest map, which `skip` then is. (X, F, *size)."""
        if self.resConfUnit1 is not None and coarse is not None:
            skip = coarse + self.resConfUnit1(skip)
        # The release resizes first. A 1 x 1 convolution commutes with weights that sum to 1, and
        # has a quarter of the pixels here.
        return resized(self.out_conv(self.resConfUnit2(skip)), size)


class Scratch(nn.Module):
    """The part of a head behind its joined maps, under its published names."""

    def __init__(self, channels: Sequence[int], features: int, ends_in_depth: bool) -> None:
        super().__init__()
        for number, width in enumerate(channels, start=1):
            projected = nn.Conv2d(width, features, 3, padding=1, bias=False)
            self.add_module(f"layer{number}_rn", projected)
            fusion = Fusion(features, coarsest=number == len(channels))
            self.add_module(f"refinenet{number}", fusion)
        self.output_conv = _to_depth(features) if ends_in_depth else None

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        """Maps of 1/2 to 1/16, fine ones first, to a full-size map (X, F or 1, H, W)."""
        path = None
        # From coarse to fine: each fusion doubles the size.
        for number in range(len(maps), 0, -1):
            skip = self.get_submodule(f"layer{number}_rn")(maps[number - 1])
            full = [2 * side for side in maps[0].shape[-2:]]
            size = maps[number - 2].shape[-2:] if number > 1 else full
            path = self.get_submodule(f"refinenet{number}")(path, skip, size)
        assert path is not None
        return path if self.output_conv is None else self.output_conv(path)


def _to_depth(features: int) -> nn.Sequential:
    """A correction of depth, 0 at the start."""
    return nn.Sequential(
        *two_convolutions(features, features // 2, 16, "replicate"),
        nn.GELU(),
        zeroed(nn.Conv2d(16, 1, 1)),
    )


class DptHead(nn.Module):
    """Four maps of a ViT at 1/8, with other features, to one map of full size.

    width: channels of the ViT's maps. channels: those of the four resolutions. features: F.
    joined: channels that join at 1/2, 1/4 and 1/8, all others together.
    """

    def __init__(
        self,
        width: int,
        channels: Sequence[int],
        features: int,
        joined: Sequence[int],
        ends_in_depth: bool = False,
    ) -> None:
        super().__init__()
        c2, c4, _, c16 = channels
        self.projects = nn.ModuleList(nn.Conv2d(width, channel, 1) for channel in channels)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(c2, c2, 4, 4),
                nn.ConvTranspose2d(c4, c4, 2, 2),
                nn.Identity(),
                nn.Conv2d(c16, c16, 3, 2, 1),
            ]
        )
        # One stands also where nothing joins: there it maps its own features alone.
        self.concat_projects = nn.ModuleList(
            nn.Conv2d(own + other, own, 1)
            for own, other in zip(channels[:LEVELS], joined, strict=True)
        )
        self.scratch = Scratch(channels, features, ends_in_depth)

    def forward(
        self,
        maps: Sequence[Tensor],  # four of (X, C, H/8, W/8)
        joined: Sequence[tuple[Sequence[Tensor], Sequence[Tensor]]],
    ) -> Tensor:
        """(X, F, H, W), or (X, 1, H, W) of a head that ends in depth.

        joined: maps at 1/2, 1/4, 1/8, those before and those behind the head's own channels.
        """
        own = [
            resize(project(x))
            for x, project, resize in zip(maps, self.projects, self.resize_layers, strict=True)
        ]
        for level, (before, behind) in enumerate(joined):
            together = torch.cat([*before, own[level], *behind], 1)
            own[level] = self.concat_projects[level](together)
        return self.scratch(own)

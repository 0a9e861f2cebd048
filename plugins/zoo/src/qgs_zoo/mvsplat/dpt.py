"""DepthSplat's DPT heads (Ranftl et al., arXiv 2103.13413), from ViT tokens to full-size maps.

Four maps of a ViT are resized to 1/2, 1/4, 1/8 and 1/16 of the image size. Features of other
networks are concatenated with the maps at 1/2, 1/4 and 1/8. Then each map is added to the next
finer map, from coarse to fine.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from qgs_zoo.mvsplat.unet import conv3, resized, two_convolutions, zeroed

Joined = list[tuple[list[Tensor], list[Tensor]]]
"""Maps of other networks, two lists for each of the sizes 1/2, 1/4 and 1/8: maps to put before the
ViT's channels, and maps to put after them."""
LEVELS = 3
"""Number of resolutions (1/2, 1/4, 1/8) at which other networks' maps are appended to ViT maps."""


class ResidualUnit(nn.Module):
    """Residual unit x + conv(relu(conv(relu(x)))) with 3 x 3 convolutions, on maps (X, F, h, w)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = conv3(channels, channels)
        self.conv2 = conv3(channels, channels)

    def forward(self, x_XFhw: Tensor) -> Tensor:
        return x_XFhw + self.conv2(self.conv1(x_XFhw.relu()).relu())


class Fusion(nn.Module):
    """Network that adds a map to the sum of all coarser maps, and resizes the result."""

    def __init__(self, channels: int, coarsest: bool) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(channels, channels, 1)
        self.resConfUnit1 = None if coarsest else ResidualUnit(channels)
        self.resConfUnit2 = ResidualUnit(channels)

    def forward(self, coarse: Tensor | None, skip: Tensor, size: Sequence[int]) -> Tensor:
        """Return the sum of the maps `skip` and `coarse`, resized to `size`: (X, F, *size).

        X: number of images. F: channels. coarse: sum of all maps coarser than `skip`, or None if
        `skip` is the coarsest map.
        """
        if self.resConfUnit1 is not None and coarse is not None:
            skip = coarse + self.resConfUnit1(skip)
        # The release resizes first. The weights of resizing sum to 1, so it commutes with a 1 x 1
        # convolution, which has a quarter of the pixels here.
        return resized(self.out_conv(self.resConfUnit2(skip)), size)


class Scratch(nn.Module):
    """Part of a DPT head that adds maps of four resolutions, with the published parameter names."""

    def __init__(self, channels: Sequence[int], features: int, ends_in_depth: bool) -> None:
        super().__init__()
        for number, width in enumerate(channels, start=1):
            projected = conv3(width, features, bias=False)
            self.add_module(f"layer{number}_rn", projected)
            fusion = Fusion(features, coarsest=number == len(channels))
            self.add_module(f"refinenet{number}", fusion)
        last: list[nn.Module] = []
        if ends_in_depth:
            # The correction is 0 before training.
            hidden = two_convolutions(features, features // 2, 16, "replicate")
            last = [*hidden, nn.GELU(), zeroed(nn.Conv2d(16, 1, 1))]
        self.output_conv = nn.Sequential(*last)

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        """Return a full-size map from maps at 1/2, 1/4, 1/8 and 1/16 of the image size.

        The result for X images has F channels, (X, F, H, W). With `ends_in_depth`, it is a
        correction of depth, (X, 1, H, W).
        """
        path = None
        # From coarse to fine: each fusion doubles the size.
        for number in range(len(maps), 0, -1):
            skip = self.get_submodule(f"layer{number}_rn")(maps[number - 1])
            full = [2 * side for side in maps[0].shape[-2:]]
            size = maps[number - 2].shape[-2:] if number > 1 else full
            path = self.get_submodule(f"refinenet{number}")(path, skip, size)
        assert path is not None
        return self.output_conv(path)


class DptHead(nn.Module):
    """Head that combines four ViT maps at 1/8 size and maps of other networks in a full-size map.

    width: channels of the ViT's maps. channels: channels of the head at its four resolutions.
    features: F, channels of the result. joined: total channels of the other networks' maps at 1/2,
    1/4 and 1/8. ends_in_depth: True makes the result one channel, a correction of depth.
    """

    def __init__(
        self,
        width: int,
        channels: Sequence[int],
        features: int,
        joined: Sequence[int],
        ends_in_depth: bool,
    ) -> None:
        super().__init__()
        c2, c4, _, c16 = channels
        self.projects = nn.ModuleList(nn.Conv2d(width, channel, 1) for channel in channels)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(c2, c2, 4, 4),
                nn.ConvTranspose2d(c4, c4, 2, 2),
                nn.Identity(),
                conv3(c16, c16, stride=2),
            ]
        )
        # One exists even if nothing joins: it then maps the features of the ViT alone.
        self.concat_projects = nn.ModuleList(
            nn.Conv2d(own + other, own, 1)
            for own, other in zip(channels[:LEVELS], joined, strict=True)
        )
        self.scratch = Scratch(channels, features, ends_in_depth)

    def forward(
        self,
        maps: Sequence[Tensor],  # four of (X, C, H/8, W/8)
        joined: Joined,
    ) -> Tensor:
        """Return a full-size map (X, F, H, W), or (X, 1, H, W) if the head ends in depth.

        X: number of images. F: channels.
        """
        own = [
            resize(project(x))
            for x, project, resize in zip(maps, self.projects, self.resize_layers, strict=True)
        ]
        for level, (before, behind) in enumerate(joined):
            own[level] = self.concat_projects[level](torch.cat([*before, own[level], *behind], 1))
        return self.scratch(own)

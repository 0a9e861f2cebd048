"""DepthSplat's DPT heads (Ranftl et al., arXiv 2103.13413), from ViT tokens to full-size maps.

Four maps of a ViT are resized to 1/2, 1/4, 1/8 and 1/16 of the image size. Features of other
networks are concatenated with the maps at 1/2, 1/4 and 1/8. Then each map is added to the next
finer map, from coarse to fine.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from qgs_zoo.mvsplat.unet import conv3, resized, two_convolutions, zeroed

Joined = list[list[Tensor]]
"""Maps of other networks, a list for each of the sizes 1/2, 1/4 and 1/8."""
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
        self.resConfUnit1 = nn.Identity() if coarsest else ResidualUnit(channels)
        self.resConfUnit2 = ResidualUnit(channels)

    def forward(self, coarse: Tensor, skip: Tensor, size: Sequence[int]) -> Tensor:
        """Return the sum of the maps `skip` and `coarse`, resized to `size`: (X, F, *size).

        X: number of images. F: channels. coarse: sum of all maps coarser than `skip`, which is 0 if
        `skip` is the coarsest map.
        """
        summed = coarse + self.resConfUnit1(skip)
        # The release resizes first. The weights of resizing sum to 1, so it commutes with a 1 x 1
        # convolution, which has a quarter of the pixels here.
        return resized(self.out_conv(self.resConfUnit2(summed)), size)


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
        # The names of the layers that add maps, from coarse to fine, are published.
        self.scratch = nn.ModuleDict()
        for number, own in enumerate(channels, start=1):
            self.scratch[f"layer{number}_rn"] = conv3(own, features, bias=False)
            fusion = Fusion(features, coarsest=number == len(channels))
            self.scratch[f"refinenet{number}"] = fusion
        last: list[nn.Module] = []
        if ends_in_depth:
            # The correction is 0 before training.
            hidden = two_convolutions(features, features // 2, 16, "replicate")
            last = [*hidden, nn.GELU(), zeroed(nn.Conv2d(16, 1, 1))]
        self.scratch["output_conv"] = nn.Sequential(*last)

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
        for level, others in enumerate(joined):
            # The ViT's map is the second one, after the CNN's, but the last one at 1/2 (release).
            before = 1 if level else len(others)
            seen = [*others[:before], own[level], *others[before:]]
            own[level] = self.concat_projects[level](torch.cat(seen, 1))
        path = own[0].new_zeros(())
        full = [2 * side for side in own[0].shape[-2:]]
        sizes = [full, *(x.shape[-2:] for x in own)]
        # From coarse to fine: each fusion doubles the size.
        for number in range(len(own), 0, -1):
            skip = self.scratch[f"layer{number}_rn"](own[number - 1])
            path = self.scratch[f"refinenet{number}"](path, skip, sizes[number - 1])
        return self.scratch["output_conv"](path)

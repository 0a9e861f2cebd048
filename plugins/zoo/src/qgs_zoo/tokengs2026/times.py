"""Embedding of times (TokenGS 2026.6). Axes: T channels."""

import math
from collections.abc import Iterator

import torch
from torch import Tensor, nn

from qgs.contracts import Problem, RecipeContext
from qgs.geometry.precision import full_precision


@full_precision
def time_features(times: Tensor, channels: int) -> Tensor:
    """Times (...) -> (..., T): cos, then sin, of t exp(-ln(10000) i / (T/2)), i = 0 … T/2 - 1."""
    half = channels // 2
    rates = torch.exp(-math.log(10_000) / half * torch.arange(half, device=times.device).to(times))
    angles = times[..., None] * rates
    return torch.cat([angles.cos(), angles.sin()], -1)


def without_times(channels: int, context: RecipeContext) -> Iterator[Problem]:
    """A problem of the option `time_channels` if the data of the recipe have no times."""
    if channels and context.inputs is not None and not context.times:
        yield Problem(
            "time_channels",
            f"the data of this recipe have no times: `time_channels: {channels}` reads them",
            "set time_channels to 0, or take qgs/photos (each frame of a transforms file with its "
            "'time') or datasets/chunks packed from them",
        )


class TimeEmbedding(nn.Module):
    """Times (B, V) -> (B, V, D), zeros at first.

    A convolution of P x P pixels that are all equal, because the release embeds a map of times.
    """

    def __init__(self, channels: int, width: int, patch_size: int) -> None:
        """channels: T, even."""
        super().__init__()
        self.proj = nn.Conv2d(channels, width, kernel_size=patch_size, stride=patch_size)
        for parameter in self.proj.parameters():
            nn.init.zeros_(parameter)

    def forward(self, times: Tensor) -> Tensor:
        numbers = time_features(times, self.proj.in_channels).flatten(0, 1)
        patches = numbers[..., None, None].expand(-1, -1, *self.proj.kernel_size)
        return self.proj(patches)[..., 0, 0].unflatten(0, times.shape)

"""Renderers with the right colours, but wrong depth, alpha or gradients without Gaussians."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from torch import Tensor

from qgs.renderers import TorchRenderer
from qgs.types import Cameras, Gaussians, Rendering


class LosesDepth(TorchRenderer):
    name: ClassVar[str] = "loses_depth"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        out = super().forward(gaussians, cameras, background)
        return replace(out, depth=0 * out.depth)


class SquashesDepth(TorchRenderer):
    """Gives sum(w z), as if every pixel were opaque."""

    name: ClassVar[str] = "squashes_depth"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        out = super().forward(gaussians, cameras, background)
        return replace(out, depth=out.alpha * out.depth)


class DetachesDepth(TorchRenderer):
    name: ClassVar[str] = "detaches_depth"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        out = super().forward(gaussians, cameras, background)
        return replace(out, depth=out.depth.detach())


class DetachesAlpha(TorchRenderer):
    name: ClassVar[str] = "detaches_alpha"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        out = super().forward(gaussians, cameras, background)
        return replace(out, alpha=out.alpha.detach())


class CountsWhatIsThere(TorchRenderer):
    """Takes a root of the number of Gaussians, whose gradient is infinite at none."""

    name: ClassVar[str] = "counts_what_is_there"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        out = super().forward(gaussians, cameras, background)
        reach = 1 + cameras.c2w[..., :3, 3].square().sum()
        idle = 0 * (gaussians.means.shape[1] * reach).sqrt()
        return replace(out, rgb=out.rgb + idle)

"""Components that treat few queries, tokens, Gaussians or scenes well, and many otherwise."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from qgs.components import ContentCrossAttention, ContentSelfAttention
from qgs.renderers import TorchRenderer
from qgs.types import Cameras, Gaussians, ImageMemory, QueryState, Rendering


class Windowed(ContentSelfAttention):
    """Attends within windows of 16 consecutive queries."""

    name: ClassVar[str] = "windowed"

    def forward(self, state: QueryState) -> Tensor:
        return torch.cat([self.attention(x) for x in self.norm(state.features).split(16, 1)], 1)


class FirstTokens(ContentCrossAttention):
    name: ClassVar[str] = "first_tokens"

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        keys, values = memory.keys[:, :, :64], memory.values[:, :, :64]
        return self.core(state.features, keys, values)


class FirstGaussians(TorchRenderer):
    name: ClassVar[str] = "first_gaussians"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        first = Gaussians(
            gaussians.means[:, :64],
            gaussians.scales[:, :64],
            gaussians.quats[:, :64],
            gaussians.opacities[:, :64],
            gaussians.colors[:, :64],
        )
        return super().forward(first, cameras, background)


class MixesManyScenes(ContentSelfAttention):
    name: ClassVar[str] = "mixes_many_scenes"

    def forward(self, state: QueryState) -> Tensor:
        update = super().forward(state)
        return update - update.mean(0, keepdim=True) if len(update) > 4 else update

"""Components that know an axis of the world, or which query, view or Gaussian is which."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from qgs.components import ContentCrossAttention, MlpFeedForward
from qgs.contracts import Loss
from qgs.renderers import TorchRenderer
from qgs.types import (
    Cameras,
    Gaussians,
    ImageMemory,
    LayerPrediction,
    QueryState,
    Rendering,
    Views,
)


class KnowsWhatIsUp(Loss):
    """Sees no shift of the world and no turn about its y axis."""

    name: ClassVar[str] = "knows_what_is_up"
    renderings = "none"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        height = prediction.gaussians.means[..., 1]
        return {"spread": (height - height.mean(1, keepdim=True)).square().mean()}


class DarkensTheSky(TorchRenderer):
    """Colours by the height above the first camera, along the world's y axis."""

    name: ClassVar[str] = "darkens_the_sky"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        height = gaussians.means[..., 1:2] - cameras.c2w[:, :1, 1, 3:]
        colors = gaussians.colors * height.sigmoid()
        return super().forward(replace(gaussians, colors=colors), cameras, background)


class WatchesTheFirstQuery(Loss):
    name: ClassVar[str] = "watches_the_first_query"
    renderings = "none"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        return {"size": prediction.gaussians.scales[:, :1].mean()}


class NumbersGaussians(TorchRenderer):
    """Later Gaussians are fainter."""

    name: ClassVar[str] = "numbers_gaussians"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        number = torch.arange(gaussians.means.shape[1]).to(gaussians.means)
        opacities = gaussians.opacities / (1 + number / 100)
        return super().forward(replace(gaussians, opacities=opacities), cameras, background)


class DropsQueriesInTraining(MlpFeedForward):
    """Every second query, by its number, is left as it is in training."""

    name: ClassVar[str] = "drops_queries_in_training"

    def forward(self, features: Tensor) -> Tensor:
        update = super().forward(features)
        kept = (torch.arange(update.shape[1]) % 2).to(update)[:, None]
        return update * kept if self.training else update


class DropsAViewInTraining(ContentCrossAttention):
    name: ClassVar[str] = "drops_a_view_in_training"

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        views = memory.grid[0]
        if not self.training or views == 1:
            return super().forward(state, memory)
        first = memory.keys.shape[2] // views
        return self.core(state.features, memory.keys[:, :, first:], memory.values[:, :, first:])

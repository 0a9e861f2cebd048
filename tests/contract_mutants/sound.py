"""Components that look suspicious and keep the contract."""

from __future__ import annotations

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.components import ContentCrossAttention, MlpFeedForward
from qgs.renderers import TorchRenderer
from qgs.types import Cameras, Gaussians, ImageMemory, QueryState, Rendering


class DropsOut(MlpFeedForward):
    name: ClassVar[str] = "drops_out"

    def forward(self, features: Tensor) -> Tensor:
        return F.dropout(super().forward(features), 0.2, self.training)


class RefusesIntrinsics(TorchRenderer):
    name: ClassVar[str] = "refuses_intrinsics"
    camera_gradients = ("c2w",)

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        if cameras.intrinsics.requires_grad:
            raise ValueError("there is no gradient of intrinsics; detach them")
        return super().forward(gaussians, cameras, background)


class ReadsTheFirstViewMost(ContentCrossAttention):
    name: ClassVar[str] = "reads_the_first_view_most"
    ordered_views = True

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        views = memory.grid[0]
        values = memory.values.unflatten(2, (views, -1))
        first = (values[:, :, :1] + values).flatten(2, 3)
        return self.core(state.features, memory.keys, first)


class LeavesItselfOut(MlpFeedForward):
    """Stochastic depth: half of its training passes update nothing."""

    name: ClassVar[str] = "leaves_itself_out"

    def forward(self, features: Tensor) -> Tensor:
        update = super().forward(features)
        return update * (torch.rand(()) > 0.5).to(update) if self.training else update

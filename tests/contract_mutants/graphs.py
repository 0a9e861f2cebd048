"""Components that torch.compile has to trace anew for every size, or traces wrongly."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from qgs.components import ContentCrossAttention, MlpFeedForward
from qgs.types import ImageMemory, QueryState


class LoopsOverQueries(MlpFeedForward):
    name: ClassVar[str] = "loops_over_queries"

    def forward(self, features: Tensor) -> Tensor:
        updates = [self.mlp(self.norm(features[:, i])) for i in range(features.shape[1])]
        return torch.stack(updates, 1)


class LoopsOverViews(ContentCrossAttention):
    name: ClassVar[str] = "loops_over_views"

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        values = memory.values.chunk(memory.grid[0], 2)
        return self.core(state.features, memory.keys, torch.cat([1.0 * x for x in values], 2))


class CutsItsGradientCompiled(MlpFeedForward):
    name: ClassVar[str] = "cuts_its_gradient_compiled"

    def forward(self, features: Tensor) -> Tensor:
        if torch.compiler.is_compiling():
            features = features.detach()
        return super().forward(features)

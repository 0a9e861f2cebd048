"""Components that look suspicious and keep the contract."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch
import torch.nn.functional as F
from contract_mutants.learning import RefusesWhatItDeclares
from torch import Tensor, nn

from qgs.components import ContentCrossAttention, MlpFeedForward
from qgs.contracts import ComponentConfig, Fields, FieldSpec, ModelDims, Queries
from qgs.renderers import TorchRenderer
from qgs.types import Cameras, Gaussians, ImageMemory, QueryState, Rendering


class DropsOut(MlpFeedForward):
    name: ClassVar[str] = "drops_out"

    def forward(self, features: Tensor) -> Tensor:
        return F.dropout(super().forward(features), 0.2, self.training)


class RefusesIntrinsics(RefusesWhatItDeclares):
    name: ClassVar[str] = "refuses_intrinsics"
    camera_gradients = ("c2w",)


class Fades(TorchRenderer):
    name: ClassVar[str] = "fades"

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        faded = replace(gaussians, opacities=0.7 * gaussians.opacities)
        return super().forward(faded, cameras, background)


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


class DecodesItsQueries(Queries):
    """Codes of each query, and what all share: a layer, and the logarithm of a size."""

    name: ClassVar[str] = "decodes_its_queries"

    class Config(ComponentConfig):
        count: int = 8

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.code = nn.Parameter(torch.randn(config.count, 16))
        self.log_size = nn.Parameter(torch.zeros(()))
        self.up = nn.Linear(16, dims.width)

    @property
    def count(self) -> int:
        return self.code.shape[0]

    @classmethod
    def provides(cls, config: ComponentConfig) -> Fields:
        return {"place.size": FieldSpec((1,))}

    def forward(self, batch_size: int) -> QueryState:
        size = self.log_size.exp().expand(batch_size, self.count, 1)
        return QueryState(
            self.up(self.code).expand(batch_size, -1, -1), {"place.size": size.clone()}
        )

    def resized(
        self, learned: Mapping[str, Tensor], generator: torch.Generator
    ) -> dict[str, Tensor]:
        codes = super().resized({"code": learned["code"]}, generator)
        return {**learned, **codes}

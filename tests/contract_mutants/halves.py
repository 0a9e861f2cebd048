"""Components that take geometry through half precision and hand it on as float32."""

from __future__ import annotations

from typing import ClassVar

import torch
import torch.nn.functional as F
from contract_mutants.modules import PLACE
from contract_mutants.traces import Steps
from torch import Tensor, nn

from qgs.components import ContentCrossAttention, FreeCenters, GaussianHead, LatentQueries
from qgs.contracts import (
    MEMORY_FIELDS,
    AttentionWeights,
    ComponentConfig,
    Fields,
    Loss,
    ModelDims,
)
from qgs.types import GaussianAttributes, ImageMemory, LayerPrediction, QueryState, Rendering, Views

TURN = torch.tensor([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])


class MatmulThenFloat(FreeCenters):
    name: ClassVar[str] = "matmul_then_float"

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        means = super().forward(offsets, state)
        return (means @ TURN.to(means)).to(means)


class TurnsInHalf(Steps):
    name: ClassVar[str] = "turns_in_half"

    def turned(self, step: Tensor, center: Tensor) -> Tensor:
        return (step.to(center) @ TURN.to(center)).to(center)

    def moved(self, center: Tensor, step: Tensor) -> dict[str, Tensor]:
        return super().moved(center, self.turned(step, center))


class LinearThenFloat(TurnsInHalf):
    name: ClassVar[str] = "linear_then_float"

    def turned(self, step: Tensor, center: Tensor) -> Tensor:
        return step.to(center) + F.linear(center, TURN.to(center)).to(center)


class TurnsInFull(TurnsInHalf):
    """Sound: its layer runs in half precision, and what it does in space does not."""

    name: ClassVar[str] = "turns_in_full"

    def turned(self, step: Tensor, center: Tensor) -> Tensor:
        step *= 2
        return (step.to(center)[..., None, :] * TURN.T.to(center)).sum(-1)


class PlacesQueriesInHalf(LatentQueries):
    name: ClassVar[str] = "places_queries_in_half"

    def __init__(self, config: LatentQueries.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.center = nn.Parameter(torch.randn(config.count, 3))
        self.turn = nn.Parameter(TURN.clone())

    @classmethod
    def provides(cls, config: ComponentConfig) -> Fields:
        return PLACE

    def forward(self, batch_size: int) -> QueryState:
        center = (self.center @ self.turn).to(self.center)
        state = super().forward(batch_size)
        return state.replace(fields={"place.center": center.expand(batch_size, -1, -1)})


class DecodesInHalf(GaussianHead):
    name: ClassVar[str] = "decodes_in_half"

    def activate(self, raw: Tensor) -> GaussianAttributes:
        good = super().activate(raw)
        opacities = torch.sigmoid(raw[..., -1] + self.config.opacity_bias).to(good.scales)
        return GaussianAttributes(good.offsets, good.scales, good.quats, opacities, good.colors)


class BiasesInHalf(ContentCrossAttention):
    name: ClassVar[str] = "biases_in_half"

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        memory = ("memory.keys", "memory.values", "memory.patch_rays")
        return {**PLACE, **{name: MEMORY_FIELDS[name] for name in memory}}

    def bias(self, state: QueryState, memory: ImageMemory) -> Tensor:
        center, directions = state["place.center"], memory.patch_rays[..., 3:]
        return (center @ directions.transpose(-1, -2)).to(center)

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        bias = self.bias(state, memory)
        return self.core(state.features, memory.keys, memory.values, bias)

    def explain(self, state: QueryState, memory: ImageMemory, queries: Tensor) -> AttentionWeights:
        bias = self.bias(state, memory)
        return self.core.explain(state.features, memory.keys, queries, bias)


class MeasuresInHalf(Loss):
    name: ClassVar[str] = "measures_in_half"
    renderings = "none"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        scales = prediction.gaussians.scales
        return {"volume": (scales @ scales.mT).mean((1, 2)).mean().to(scales)}

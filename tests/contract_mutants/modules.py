"""Decoder components that are sound but for one thing in their forward pass."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from qgs.components import (
    ContentCrossAttention,
    ContentSelfAttention,
    FreeCenters,
    GaussianHead,
    LatentQueries,
    MlpFeedForward,
    MultiViewViT,
    NoRefinement,
)
from qgs.contracts import MEMORY_FIELDS, ComponentConfig, Fields, FieldSpec, ModelDims
from qgs.types import GaussianAttributes, ImageMemory, QueryState, Views

PLACE: Fields = {"place.center": FieldSpec((3,), frame="world")}


class DrawsAndForgets(MlpFeedForward):
    name: ClassVar[str] = "draws_and_forgets"

    def forward(self, features: Tensor) -> Tensor:
        torch.rand(1)
        return super().forward(features)


class AddsNoise(MlpFeedForward):
    name: ClassVar[str] = "adds_noise"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features) + 0.01 * torch.randn_like(features)


class MixesScenes(MlpFeedForward):
    name: ClassVar[str] = "mixes_scenes"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features - features.mean(0, keepdim=True))


class CountsScenes(MlpFeedForward):
    name: ClassVar[str] = "counts_scenes"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features) / features.shape[0]


class NumbersQueries(ContentSelfAttention):
    name: ClassVar[str] = "numbers_queries"

    def forward(self, state: QueryState) -> Tensor:
        number = torch.arange(state.features.shape[1]).to(state.features)
        return super().forward(state) + number[:, None]


class NumbersTokens(ContentCrossAttention):
    name: ClassVar[str] = "numbers_tokens"

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        number = torch.arange(memory.keys.shape[2]).to(memory.keys)
        return self.core(state.features, memory.keys + number[:, None], memory.values)


class KnowsSixQueries(MlpFeedForward):
    name: ClassVar[str] = "knows_six_queries"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.place = nn.Parameter(torch.zeros(6, dims.width))

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features + self.place)


class CutsItsGradient(MlpFeedForward):
    name: ClassVar[str] = "cuts_its_gradient"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features) + features.square().detach()


class PlacesInHalf(FreeCenters):
    name: ClassVar[str] = "places_in_half"

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        return offsets @ torch.eye(3).to(offsets)


class Cancels(MlpFeedForward):
    name: ClassVar[str] = "cancels"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward((features + 300) - 300)


class ForgetsFloat64(MlpFeedForward):
    name: ClassVar[str] = "forgets_float64"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features).float()


class StaysOnCpu(MlpFeedForward):
    name: ClassVar[str] = "stays_on_cpu"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features) * torch.ones(features.shape[-1])


class ClampsItsInput(FreeCenters):
    name: ClassVar[str] = "clamps_its_input"

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        return super().forward(offsets.data.clamp_(-0.1, 0.1), state)


class ReturnsItsInput(MlpFeedForward):
    name: ClassVar[str] = "returns_its_input"

    def forward(self, features: Tensor) -> Tensor:
        return features.view_as(features)


class Counts(MlpFeedForward):
    name: ClassVar[str] = "counts"
    calls = 0

    def forward(self, features: Tensor) -> Tensor:
        self.calls += 1
        return super().forward(features)


class GrowsATuple(MlpFeedForward):
    name: ClassVar[str] = "grows_a_tuple"
    seen: tuple[str, ...] = ()

    def forward(self, features: Tensor) -> Tensor:
        self.seen = (*self.seen, "x")
        return super().forward(features) + len(self.seen) - len(self.seen)


class WritesMore(NoRefinement):
    name: ClassVar[str] = "writes_more"

    def forward(self, state: QueryState) -> QueryState:
        return state.replace(fields={"place.center": state.features[..., :3].clone()})


class ReadsMemoryUndeclared(ContentCrossAttention):
    name: ClassVar[str] = "reads_memory_undeclared"

    def forward(self, state: QueryState, memory: ImageMemory) -> Tensor:
        return super().forward(state, memory) + memory.features.mean(1, keepdim=True)


class RequiresTooMuch(ContentCrossAttention):
    name: ClassVar[str] = "requires_too_much"

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        return MEMORY_FIELDS


class NeedsWhatItHides(ContentSelfAttention):
    name: ClassVar[str] = "needs_what_it_hides"

    def forward(self, state: QueryState) -> Tensor:
        return super().forward(state) + state["place.center"].sum(-1, keepdim=True)


class DividesByLength(MlpFeedForward):
    name: ClassVar[str] = "divides_by_length"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features / features.norm(dim=-1, keepdim=True))


class Exponentiates(MlpFeedForward):
    name: ClassVar[str] = "exponentiates"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features.exp())


class DividesBySpread(MlpFeedForward):
    name: ClassVar[str] = "divides_by_spread"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features / (features - features[:, :1]).norm())


class DividesByDepth(ContentSelfAttention):
    name: ClassVar[str] = "divides_by_depth"

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        return PLACE

    def forward(self, state: QueryState) -> Tensor:
        place = state["place.center"]
        return super().forward(state) + place[..., :1] / place[..., 2:]


class DividesByBaseline(MultiViewViT):
    name: ClassVar[str] = "divides_by_baseline"

    def forward(self, views: Views) -> ImageMemory:
        memory = super().forward(views)
        eyes = views.cameras.c2w[..., :3, 3]
        baseline = (eyes - eyes[:, :1]).norm(dim=-1).sum(1)
        values = memory.values / baseline[:, None, None, None]
        return ImageMemory(memory.keys, values, memory.features, memory.patch_rays, memory.grid)


class LongQuaternions(GaussianHead):
    name: ClassVar[str] = "long_quaternions"

    def activate(self, raw: Tensor) -> GaussianAttributes:
        good = super().activate(raw)
        return GaussianAttributes(
            good.offsets, good.scales, 2 * good.quats, good.opacities, good.colors
        )


class TellsScenesApart(LatentQueries):
    name: ClassVar[str] = "tells_scenes_apart"

    def forward(self, batch_size: int) -> QueryState:
        state = super().forward(batch_size)
        scene = torch.arange(batch_size).to(state.features)[:, None, None]
        return state.replace(state.features + scene)


class NeverResizes(LatentQueries):
    name: ClassVar[str] = "never_resizes"

    def resized(self, learned, generator):
        return dict(learned)

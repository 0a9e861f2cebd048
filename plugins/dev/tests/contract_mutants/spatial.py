"""Components that read or write other fields, lose digits, or know an order or the world frame."""

import torch
from contract_mutants.mutant import mutant
from torch import nn

from qgs.contracts import MEMORY_FIELDS, FieldSpec, Loss, Refinement, memory_fields
from qgs.renderers import TorchRenderer
from qgs.tokengs import (
    ContentCrossAttention,
    ContentSelfAttention,
    CrossSelfMlp,
    FreeCenters,
    GaussianHead,
    MlpFeedForward,
    NoRefinement,
)
from qgs.types import QueryState

CHECK = "reads_are_declared"


PLACE = {"place.center": FieldSpec((3,), frame="world")}


class Extended:
    """A sound component with parts that are added when it is built."""

    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.add(dims)


class AtPlaces:
    """A component that reads centres."""

    reads = PLACE


class PlacesByALayer(Extended, AtPlaces, ContentSelfAttention):
    """Attention that has a layer for centres."""

    def add(self, dims):
        self.place = nn.Linear(3, dims.width)


@mutant(CHECK, "reads some of memory.features, memory.grid, memory.patch_rays")
class ReadsMemoryUndeclared(ContentCrossAttention):
    def forward(self, state, memory):
        return super().forward(state, memory) + memory.features.mean(1, keepdim=True)


@mutant(CHECK, "which it does not declare: add what it reads to `reads`")
class ReadsTheGridUndeclared(ContentCrossAttention):
    def forward(self, state, memory):
        return super().forward(state, memory) * memory.grid[0]


@mutant(CHECK, "anchor.center: read in")
class ReadsAFieldIfThere(ContentSelfAttention):
    def forward(self, state):
        center = state.fields.get("anchor.center")
        update = super().forward(state)
        return update if center is None else update + center.sum(-1, keepdim=True)


@mutant(CHECK, "reads some of rendering.alpha")
class ReadsAnUndeclaredRendering(Loss):
    renderings = "none"

    def term(self, prediction, rendering, target, inputs):
        return {"small": prediction.gaussians.scales.mean() + rendering.rgb.sum()}


@mutant("declared_reads_are_used", "requires memory.features, but")
class RequiresTooMuch(ContentCrossAttention):
    reads = MEMORY_FIELDS


@mutant("writes_are_declared", "place.center: written in")
class WritesMore(NoRefinement):
    def forward(self, state):
        return state.replace(fields={"place.center": state.features[..., :3].clone()})


@mutant("unmet_reads_fail_at_compose", "KeyError")
class NeedsAFieldUndeclared(ContentSelfAttention):
    def forward(self, state):
        return super().forward(state) + state["place.center"].sum(-1, keepdim=True)


@mutant("writes_are_declared", "unrelated.center: lost in")
class LayerLosesFields(CrossSelfMlp):
    def forward(self, state, memory):
        state, memory = super().forward(state, memory)
        return QueryState(state.features, mask=state.mask), memory


CHECK = "geometry_is_float32_under_autocast"


@mutant(CHECK, "bfloat16, not float32")
class GivesHalf(FreeCenters):
    def forward(self, offsets, state):
        return offsets @ torch.eye(3).to(offsets)


@mutant(CHECK, "place.center: values differ")
class TurnsInHalf(Extended, AtPlaces, Refinement):
    """Moves the centres by sums of what a layer gives."""

    def add(self, dims):
        self.step = nn.Linear(dims.width, 3)

    writes = PLACE

    def forward(self, state):
        center = state["place.center"]
        step = self.step(state.features).to(center) @ torch.ones(3, 3).to(center)
        return state.replace(fields={"place.center": center + step.to(center)})


@mutant(CHECK, "opacities: values differ")
class DecodesInHalf(GaussianHead):
    def activate(self, raw):
        good = super().activate(raw)
        opacities = torch.sigmoid(raw[..., -1] + self.config.opacity_bias).to(good.scales)
        return good.replace(opacities=opacities)


class BiasedAttention(ContentCrossAttention):
    """Attention with the bias that a subclass computes."""

    def forward(self, state, memory):
        return self.core(state.features, memory.keys, memory.values, self.bias(state, memory))

    def explain(self, state, memory, queries):
        return self.core.explain(state.features, memory.keys, queries, self.bias(state, memory))


@mutant(CHECK, "explain.geometry")
class BiasesInHalf(BiasedAttention):
    reads = PLACE | memory_fields("keys", "values", "patch_rays")

    def bias(self, state, memory):
        center = state["place.center"]
        return (center @ memory.patch_rays[..., 3:].mT).to(center)


@mutant("forward_keeps_no_state", "in training changes a parameter or buffer")
@mutant("batch_independence", "in training, scene 0 has a gradient")
class BatchNormed(Extended, MlpFeedForward):
    def add(self, dims):
        self.statistics = nn.BatchNorm1d(dims.width)

    def forward(self, features):
        return self.statistics(super().forward(features).mT).mT


@mutant("query_permutation", "permuted queries")
class NumbersQueries(ContentSelfAttention):
    def forward(self, state):
        number = torch.arange(state.features.shape[1]).to(state.features)
        return super().forward(state) + number[:, None]


@mutant("query_permutation", "with 200 permuted queries")
class AttendsWithinWindows(ContentSelfAttention):
    """Of 16 consecutive queries."""

    def forward(self, state):
        return torch.cat([self.attention(x) for x in self.norm(state.features).split(16, 1)], 1)


@mutant("view_permutation", "permuted views")
class NumbersTokens(ContentCrossAttention):
    def forward(self, state, memory):
        number = torch.arange(memory.keys.shape[2]).to(memory.keys)
        return self.core(state.features, memory.keys + number[:, None], memory.values)


@mutant("view_permutation", "the component declares `ordered_views`")
class DeclaresAnOrder(ContentCrossAttention):
    ordered_views = True


@mutant("world_frame_makes_no_difference", "in a moved world, rgb")
class DarkensByHeight(TorchRenderer):
    """Above the first camera, along the world's y axis: no shift of the world changes it."""

    def forward(self, gaussians, cameras, background=None):
        height = gaussians.means[..., 1:2] - cameras.c2w[:, :1, 1, 3:]
        darker = gaussians.replace(colors=gaussians.colors * height.sigmoid())
        return super().forward(darker, cameras, background)

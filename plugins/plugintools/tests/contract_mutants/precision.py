"""Components that take geometry through half precision, or lose digits otherwise."""

import torch
import torch.nn.functional as F
from contract_mutants.fields import PLACE, Steps
from contract_mutants.mutant import mutant, named
from torch import Tensor

from qgs.components import (
    ContentCrossAttention,
    FreeCenters,
    GaussianHead,
    MlpFeedForward,
)
from qgs.contracts import MEMORY_FIELDS, FieldSpec
from qgs.types import GaussianAttributes

CHECK = "geometry_is_float32_under_autocast"
TURN = torch.tensor([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
RADIUS = {"place.radius": FieldSpec((1,))}


@mutant(CHECK, "bfloat16, not float32")
class GivesHalf(FreeCenters):
    def forward(self, offsets, state):
        return offsets @ torch.eye(3).to(offsets)


@mutant(CHECK, "place.center: values differ")
class TurnsInHalf(Steps):
    def turned(self, step: Tensor, center: Tensor) -> Tensor:
        return (step.to(center) @ TURN.to(center)).to(center)

    def moved(self, center, step):
        return super().moved(center, self.turned(step, center))


@mutant(CHECK, "place.center: values")
class TurnsByALayerInHalf(TurnsInHalf):
    def turned(self, step, center):
        return step.to(center) + F.linear(center, TURN.to(center)).to(center)


@named
class TurnsInFull(TurnsInHalf):
    """Sound: its layer runs in half precision, and what it does in space does not."""

    def turned(self, step, center):
        step *= 2
        return (step.to(center)[..., None, :] * TURN.T.to(center)).sum(-1)


@mutant(CHECK, "opacities: values differ")
class DecodesInHalf(GaussianHead):
    def activate(self, raw):
        good = super().activate(raw)
        opacities = torch.sigmoid(raw[..., -1] + self.config.opacity_bias).to(good.scales)
        return GaussianAttributes(good.offsets, good.scales, good.quats, opacities, good.colors)


@mutant(CHECK, "explain.geometry")
class BiasesInHalf(ContentCrossAttention):
    @classmethod
    def fields_read(cls, config):
        memory = ("memory.keys", "memory.values", "memory.patch_rays")
        return {**PLACE, **{name: MEMORY_FIELDS[name] for name in memory}}

    def bias(self, state, memory):
        center, directions = state["place.center"], memory.patch_rays[..., 3:]
        return (center @ directions.transpose(-1, -2)).to(center)

    def forward(self, state, memory):
        bias = self.bias(state, memory)
        return self.core(state.features, memory.keys, memory.values, bias)

    def explain(self, state, memory, queries):
        bias = self.bias(state, memory)
        return self.core.explain(state.features, memory.keys, queries, bias)


@mutant("explanation_is_of_the_forward_pass", "the weights change otherwise")
class ExplainsNoBias(BiasesInHalf):
    """What it says of itself leaves out what geometry adds."""

    def bias(self, state, memory):
        apart = state["place.center"][:, :, None] - memory.patch_rays[:, None, :, 3:]
        return -apart.square().sum(-1)

    def explain(self, state, memory, queries):
        return self.core.explain(state.features, memory.keys, queries)


@mutant("autocast_is_close", "`output` is off by")
class CancelsDigits(MlpFeedForward):
    def forward(self, features):
        return super().forward((features + 300) - 300)


@mutant("float64_stays_float64", "`output` is 2x6x32 float32")
class GivesFloat32(MlpFeedForward):
    def forward(self, features):
        return super().forward(features).float()

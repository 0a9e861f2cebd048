"""Components that read, write or need other fields than they declare."""

from contract_mutants.mutant import mutant
from torch import Tensor, nn

from qgs.components import (
    ContentCrossAttention,
    ContentSelfAttention,
    CrossSelfMlp,
    NoRefinement,
)
from qgs.contracts import MEMORY_FIELDS, Fields, FieldSpec, Loss, Refinement
from qgs.types import QueryState

CHECK = "reads_within_requires"
PLACE: Fields = {"place.center": FieldSpec((3,), frame="world")}


class AtPlaces:
    """A component that reads centres."""

    @classmethod
    def fields_read(cls, config):
        return PLACE


class PlacesByALayer(AtPlaces, ContentSelfAttention):
    """Attention that has a layer for centres."""

    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.place = nn.Linear(3, dims.width)


class Steps(AtPlaces, Refinement):
    """Sound: it moves the centres by a layer."""

    name = "steps"

    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.step = nn.Linear(dims.width, 3)

    @classmethod
    def fields_written(cls, config):
        return PLACE

    def moved(self, center: Tensor, step: Tensor) -> dict[str, Tensor]:
        return {"place.center": center + step.to(center)}

    def forward(self, state):
        return state.replace(fields=self.moved(state["place.center"], self.step(state.features)))


@mutant(CHECK, "reads some of memory.features, memory.patch_rays")
class ReadsMemoryUndeclared(ContentCrossAttention):
    def forward(self, state, memory):
        return super().forward(state, memory) + memory.features.mean(1, keepdim=True)


@mutant(CHECK, "reads anchor.center")
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


@mutant("requires_are_read", "requires memory.features, which")
class RequiresTooMuch(ContentCrossAttention):
    @classmethod
    def fields_read(cls, config):
        return MEMORY_FIELDS


@mutant("writes_equal_provides", "writes place.center besides")
class WritesMore(NoRefinement):
    def forward(self, state):
        return state.replace(fields={"place.center": state.features[..., :3].clone()})


@mutant("unmet_requirement_fails_at_compose", "KeyError")
class NeedsAFieldUndeclared(ContentSelfAttention):
    def forward(self, state):
        return super().forward(state) + state["place.center"].sum(-1, keepdim=True)


@mutant("writes_equal_provides", "it loses unrelated.center")
class LayerLosesFields(CrossSelfMlp):
    def forward(self, state, memory):
        state, memory = super().forward(state, memory)
        return QueryState(state.features, mask=state.mask), memory

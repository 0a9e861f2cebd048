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


@mutant(CHECK, "reads anchor.center")
class LooksForAField(ContentSelfAttention):
    def forward(self, state):
        return super().forward(state) * (2 if "anchor.center" in state else 1)


@mutant(CHECK, "reads anchor.center")
class ReadsInTraining(ContentSelfAttention):
    def forward(self, state):
        missing = self.training and "anchor.center" not in state.fields
        return super().forward(state) * (0.5 if missing else 1)


@mutant("writes_equal_provides", "it writes unrelated.center besides")
class SearchesTheFields(NoRefinement):
    def forward(self, state):
        moved = {name: x + 1 for name, x in state.fields.items() if name.endswith(".center")}
        return state.replace(fields=moved)


@mutant(CHECK, "reads some of rendering.alpha", also="masked_queries_are_not_judged")
class ReadsAnUndeclaredRendering(Loss):
    renderings = "none"

    def term(self, prediction, rendering, target, inputs):
        return {"small": prediction.gaussians.scales.mean() + rendering.rgb.sum()}


@mutant(CHECK, "reads anchor.raw_radius", also="masked_queries_are_not_judged")
class ReadsAFieldOfThePrediction(Loss):
    renderings = "none"

    def term(self, prediction, rendering, target, inputs):
        radius = prediction.state.fields.get("anchor.raw_radius")
        small = prediction.gaussians.scales.mean()
        return {"small": small if radius is None else small + radius.mean()}


@mutant(CHECK, "NoneType")
class ReadsTheGridUndeclared(ContentCrossAttention):
    def forward(self, state, memory):
        return super().forward(state, memory) / memory.grid[0]


@mutant("requires_are_read", "requires memory.grid, which")
class RequiresTheGridForNothing(ContentCrossAttention):
    @classmethod
    def fields_read(cls, config):
        return {**super().fields_read(config), "memory.grid": MEMORY_FIELDS["memory.grid"]}


@mutant(
    "requires_are_read",
    "requires memory.features, which",
    also="gradients_reach_inputs",
)
class RequiresTooMuch(ContentCrossAttention):
    @classmethod
    def fields_read(cls, config):
        return MEMORY_FIELDS


@mutant(
    "writes_equal_provides",
    "writes place.center besides",
    also="geometry_is_float32_under_autocast",  # what it writes is of the features' dtype
)
class WritesMore(NoRefinement):
    def forward(self, state):
        return state.replace(fields={"place.center": state.features[..., :3].clone()})


@mutant("writes_equal_provides", "in training it writes place.st")
class WritesMoreInTraining(Steps):
    def moved(self, center, step):
        more = {"place.step": step.to(center)} if self.training else {}
        return {**super().moved(center, step), **more}


@mutant("unmet_requirement_fails_at_compose", "KeyError", also=None)
class NeedsAFieldUndeclared(ContentSelfAttention):
    def forward(self, state):
        return super().forward(state) + state["place.center"].sum(-1, keepdim=True)


@mutant("writes_equal_provides", "it loses unrelated.center")
class LayerLosesFields(CrossSelfMlp):
    def forward(self, state, memory):
        state, memory = super().forward(state, memory)
        return QueryState(state.features, mask=state.mask), memory


@mutant("runs", "it gives a QueryState, not a tuple", also=None)
class LayerForgetsTheMemory(CrossSelfMlp):
    def forward(self, state, memory):
        return super().forward(state, memory)[0]

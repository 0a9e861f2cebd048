"""Components that look at more of the state, the memory or the rendering than they declare."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

from torch import Tensor

from qgs.components import ContentSelfAttention, FreeCenters, NoRefinement
from qgs.contracts import Loss
from qgs.types import LayerPrediction, QueryState, Rendering, Views


class ReadsAnothersFieldIfThere(ContentSelfAttention):
    name: ClassVar[str] = "reads_anothers_field_if_there"

    def forward(self, state: QueryState) -> Tensor:
        center = state.fields.get("anchor.center")
        update = super().forward(state)
        return update if center is None else update + center.sum(-1, keepdim=True)


class LooksForAField(ContentSelfAttention):
    name: ClassVar[str] = "looks_for_a_field"

    def forward(self, state: QueryState) -> Tensor:
        return super().forward(state) * (2 if "anchor.center" in state.fields else 1)


class ReadsInTry(FreeCenters):
    name: ClassVar[str] = "reads_in_try"

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        means = super().forward(offsets, state)
        try:
            return means + state["anchor.center"][:, :, None]
        except KeyError:
            return means


class ReadsWhatItCopies(ContentSelfAttention):
    name: ClassVar[str] = "reads_what_it_copies"

    def forward(self, state: QueryState) -> Tensor:
        copy = state.replace(2 * state.features)
        return super().forward(copy) + copy.fields.get("anchor.raw_radius", 0)


class ReadsInTraining(ContentSelfAttention):
    name: ClassVar[str] = "reads_in_training"

    def forward(self, state: QueryState) -> Tensor:
        missing = self.training and "anchor.center" not in state.fields
        return super().forward(state) * (0.5 if missing else 1)


class SearchesTheFields(NoRefinement):
    name: ClassVar[str] = "searches_the_fields"

    def forward(self, state: QueryState) -> QueryState:
        moved = {name: x + 1 for name, x in state.fields.items() if name.endswith(".center")}
        return state.replace(fields=moved)


class PeeksAtTheRendering(Loss):
    name: ClassVar[str] = "peeks_at_the_rendering"
    renderings = "none"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        return {"small": prediction.gaussians.scales.mean() + rendering.rgb.sum()}


class PassesFieldsOn(ContentSelfAttention):
    """Sound: it makes states by hand, with fields that it does not look at."""

    name: ClassVar[str] = "passes_fields_on"

    def forward(self, state: QueryState) -> Tensor:
        doubled: Any = replace(state, features=2 * state.features)
        return super().forward(QueryState(doubled.features, doubled.fields | {}).replace())


class DrawsAnchorsIn(Loss):
    name: ClassVar[str] = "draws_anchors_in"
    renderings = "none"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        radius = prediction.state.fields.get("anchor.raw_radius")
        small = prediction.gaussians.scales.mean()
        return {"small": small if radius is None else small + radius.mean()}

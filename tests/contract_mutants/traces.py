"""Components that leave traces where few look, and that break a promise in training alone."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from contract_mutants.modules import PLACE
from torch import Tensor, nn

from qgs.components import FreeCenters, MlpFeedForward
from qgs.contracts import ComponentConfig, Fields, FieldSpec, ModelDims, Refinement
from qgs.types import QueryState

RADIUS: Fields = {"place.radius": FieldSpec((1,))}


class Steps(Refinement):
    """Moves the centres by a layer."""

    name: ClassVar[str] = "steps"

    def __init__(self, config: ComponentConfig, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.step = nn.Linear(dims.width, 3)

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        return PLACE

    @classmethod
    def provides(cls, config: ComponentConfig) -> Fields:
        return PLACE

    def moved(self, center: Tensor, step: Tensor) -> dict[str, Tensor]:
        return {"place.center": center + step.to(center)}

    def forward(self, state: QueryState) -> QueryState:
        return state.replace(fields=self.moved(state["place.center"], self.step(state.features)))


class WritesMoreInTraining(Steps):
    name: ClassVar[str] = "writes_more_in_training"

    def moved(self, center: Tensor, step: Tensor) -> dict[str, Tensor]:
        more = {"place.step": step.to(center)} if self.training else {}
        return {**super().moved(center, step), **more}


class PlacesInHalfInTraining(Steps):
    name: ClassVar[str] = "places_in_half_in_training"

    def moved(self, center: Tensor, step: Tensor) -> dict[str, Tensor]:
        kept = center.to(step.dtype) if self.training else center
        return super().moved(center, (kept + step).to(center) - center)


class KeepsItsRadiusInHalf(Refinement):
    """A number of no frame, rounded in every layer that carries it on."""

    name: ClassVar[str] = "keeps_its_radius_in_half"

    def __init__(self, config: ComponentConfig, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.step = nn.Linear(dims.width, 1)

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        return RADIUS

    @classmethod
    def provides(cls, config: ComponentConfig) -> Fields:
        return RADIUS

    def forward(self, state: QueryState) -> QueryState:
        step, radius = self.step(state.features), state["place.radius"]
        return state.replace(fields={"place.radius": (radius.to(step.dtype) + step).to(radius)})


class FloatInTraining(MlpFeedForward):
    name: ClassVar[str] = "float_in_training"

    def forward(self, features: Tensor) -> Tensor:
        update = super().forward(features)
        return update.float() if self.training else update


class CutsInTraining(MlpFeedForward):
    """The same numbers in both modes, and other gradients in training."""

    name: ClassVar[str] = "cuts_in_training"

    def forward(self, features: Tensor) -> Tensor:
        update, squares = super().forward(features), features.square()
        return update + squares.detach() - squares if self.training else update


class LearnsFromNoise(MlpFeedForward):
    """A shift that the norm takes away again, with a gradient that only rounding makes."""

    name: ClassVar[str] = "learns_from_noise"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.lift = nn.Parameter(torch.zeros(1))

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features + self.lift)


class DetachesLaterGaussians(FreeCenters):
    name: ClassVar[str] = "detaches_later_gaussians"

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        first, later = offsets[:, :, :1], offsets[:, :, 1:]
        return super().forward(torch.cat([first, later.detach()], 2), state)


class Memo:
    """Can be called like a function, and is none."""

    def __init__(self) -> None:
        self.means: dict[str, float] = {}

    def __call__(self, x: Tensor) -> float:
        if x.device.type == "meta":
            return 0.0
        return self.means.setdefault("first", x.detach().mean().item())


class KeepsACallableMemo(MlpFeedForward):
    name: ClassVar[str] = "keeps_a_callable_memo"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.first = Memo()

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features) + self.first(features)


class KeepsAMemoInAClosure(MlpFeedForward):
    name: ClassVar[str] = "keeps_a_memo_in_a_closure"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        memo = Memo()
        self.first = lambda x: memo(x)

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features) + self.first(features)


_OF_ALL: Any = Memo()


class KeepsAMemoForAll(MlpFeedForward):
    """What the first instance was first called with stays in the module."""

    name: ClassVar[str] = "keeps_a_memo_for_all"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features) + _OF_ALL(features)


class ReturnsItsBuffer(Refinement):
    name: ClassVar[str] = "returns_its_buffer"

    def __init__(self, config: ComponentConfig, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.register_buffer("home", torch.zeros(1, 1, 3))

    @classmethod
    def provides(cls, config: ComponentConfig) -> Fields:
        return PLACE

    def forward(self, state: QueryState) -> QueryState:
        home = self.get_buffer("home").expand(*state.features.shape[:2], 3)
        return state.replace(fields={"place.center": home})

"""Slot `objective`: which passes of the model a training step makes, and what it minimises."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

from torch import Tensor

from qgs.contracts.component import Component
from qgs.types import Cameras, Gaussians, Prediction, Rendering, Views


@dataclass(frozen=True)
class Outcome:
    """The loss that is minimised, and numbers about it; all 0-d.

    total: the sum of the terms, with gradients. terms: by name, weighted, detached.
    signs: of life, as training watches them: means "psnr" and "alpha", and "deviation", the largest
        of the views' mean distances to the background.
    """

    total: Tensor
    terms: Mapping[str, Tensor]
    signs: Mapping[str, Tensor]


class Passes(Protocol):
    """Functions that training lends to an objective for one step."""

    def predict(self, inputs: Views) -> Prediction:
        """A forward pass of the model."""
        ...

    def judge(self, prediction: Prediction, targets: Views, inputs: Views) -> Outcome:
        """The recipe's losses of every supervised layer, rendered from the cameras of `targets`.

        inputs: the views that `prediction` was made from. The losses' gradients are taken here,
        layer by layer and `training.render_views` views at a time, so that memory grows with
        neither; `total` passes them on.
        """
        ...

    def render(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """A rendering with gradients, as `judge` makes it: few views' graphs exist at a time."""
        ...


class Objective(Component):
    """What a training step computes: (input Views, target Views) -> Outcome.

    It has no parameters and keeps no state. Each pass of the model that it asks for costs as much
    as another step. Names of its own terms differ from those of the recipe's losses.

    judges_inputs: whether input views may be targets too, see `training.judge_inputs`.
    """

    slot: ClassVar[str] = "objective"
    judges_inputs: ClassVar[bool] = True

    @abstractmethod
    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        """Predict from `inputs` or from some of them, judge, and add terms of its own."""

"""Contract of the slot `objective`: the model passes of a training step, and its loss."""

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

    total: the sum of the terms, with gradients.
    terms: the terms by name, weighted and detached.
    signs: numbers with which training detects collapse: the means "psnr" and "alpha", and
        "deviation", the largest of the views' mean distances to the background.
    """

    total: Tensor
    terms: Mapping[str, Tensor]
    signs: Mapping[str, Tensor]


class Passes(Protocol):
    """Functions that training gives to an objective for one step."""

    def predict(self, inputs: Views) -> Prediction:
        """Run a forward pass of the model."""
        ...

    def judge(self, prediction: Prediction, targets: Views, inputs: Views) -> Outcome:
        """Compute the recipe's losses of every supervised layer, rendered from `targets`' cameras.

        inputs: the views that `prediction` was made from. This computes the losses' gradients layer
        by layer, `training.render_views` views at a time, so that memory grows with neither.
        `total` passes the gradients on.
        """
        ...

    def render(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render with gradients, like `judge`: few views' graphs exist at a time."""
        ...


class Objective(Component):
    """Computation of a training step: (input Views, target Views) -> Outcome.

    It has no parameters and keeps no state. Each extra pass of the model costs as much as another
    step. Names of its own terms must differ from those of the recipe's losses.

    judges_inputs: True if input views may be targets too, see `training.judge_inputs`.
    """

    slot: ClassVar[str] = "objective"
    judges_inputs: ClassVar[bool] = True

    @abstractmethod
    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        """Predict from `inputs` or some of them, compute losses, and add terms of its own."""

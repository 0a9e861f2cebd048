"""Contract of the slot `objective`: the forward passes of a training step, and the step's loss."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

from torch import Tensor

from qgs.contracts.component import Component
from qgs.types import Cameras, Gaussians, Prediction, Rendering, Views


@dataclass(frozen=True)
class Outcome:
    """The loss that training minimises, and numbers to log; all tensors are 0-d.

    total: the sum of the terms, with gradients.
    terms: the terms by name, weighted and detached.
    signs: numbers by which training detects collapse: "psnr" and "alpha" are means over the
        renderings. "deviation" is the mean distance of a rendering to the background colour, the
        largest over views.
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

        inputs: the views that `prediction` was made from. The gradients of the losses are computed
        in this call, for one layer and `training.render_views` views at a time, so that memory does
        not grow with the number of layers or views. The backward pass of `total` uses them.
        """
        ...

    def render(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render with gradients; as in `judge`, autograd graphs exist for few views at a time."""
        ...


class Objective(Component):
    """Computation of a training step: (input Views, target Views) -> Outcome.

    An objective has no parameters and keeps no state. Each extra pass of the model costs about as
    much as an extra step. If it adds terms, their names must differ from those of the recipe's
    losses.

    judges_inputs: True if input views may be targets too, see `training.judge_inputs`.
    """

    slot: ClassVar[str] = "objective"
    judges_inputs: ClassVar[bool] = True

    @abstractmethod
    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        """Predict from `inputs`, or from some of these views, and compute the losses."""

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
    terms: the weighted terms by name, detached.
    signs: numbers by which training detects that the model collapses, by name. "psnr" and "alpha"
        are means over the renderings. "deviation" is the mean of |rgb - background| over the
        pixels of a view, for the view where this mean is largest.
    """

    total: Tensor
    terms: Mapping[str, Tensor]
    signs: Mapping[str, Tensor]


class Passes(Protocol):
    """Functions of the training loop that an objective calls in one training step."""

    def predict(self, inputs: Views) -> Prediction:
        """Run the model on `inputs` and return its prediction."""
        ...

    def judge(self, prediction: Prediction, targets: Views, inputs: Views) -> Outcome:
        """Compute the recipe's losses for every supervised layer.

        Each layer is rendered from the cameras of `targets`. inputs: the views from which the model
        made `prediction`. The gradients of the losses are computed in this call, for one layer and
        `training.render_views` views at a time, so that memory does not grow with the number of
        layers or views. The backward pass of `total` uses these gradients.
        """
        ...

    def render(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render with gradients; as in `judge`, memory does not grow with the number of views."""
        ...


class Objective(Component):
    """Computation of a training step: (input Views, target Views) -> Outcome.

    An objective has no parameters and keeps no state. Each extra forward pass of the model costs
    about as much as an extra step. The names of terms that an objective adds must differ from those
    of the recipe's losses.

    judges_inputs: True if the objective may compute losses on input views as well, as the option
        `training.judge_inputs` demands.
    """

    slot = "objective"
    judges_inputs: ClassVar[bool] = True

    @abstractmethod
    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        """Predict from `inputs`, or from some of these views, and compute the losses."""

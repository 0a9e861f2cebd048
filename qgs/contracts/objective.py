"""Slot `objective`: which passes of the model a training step makes, and what it minimises."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
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

    @classmethod
    def mean(cls, outcomes: Sequence["Outcome"], **terms: Tensor) -> "Outcome":
        """The mean of `outcomes` of equally many losses, plus `terms`: 0-d, weighted, named.

        Raises ValueError for a term that is named as one of the outcomes'.
        """
        first = outcomes[0]
        share = 1 / len(outcomes)
        # One of two equal names would be lost from the log.
        if taken := sorted(first.terms.keys() & terms.keys()):
            raise ValueError(f"the recipe's losses have terms {taken} already; rename the others")
        judged = {n: share * _sum(o.terms[n] for o in outcomes) for n in first.terms}
        signs = {n: share * _sum(o.signs[n] for o in outcomes) for n in first.signs}
        # One collapsed pass is a sign that a mean would hide.
        signs["deviation"] = torch.stack([o.signs["deviation"] for o in outcomes]).amax()
        total = share * _sum(o.total for o in outcomes) + _sum(terms.values())
        # Numbers for the log; their graph would hold the memory of the step.
        detached = {n: term.detach() for n, term in terms.items()}
        return cls(total, judged | detached, signs)


def _sum(terms: Iterable[Tensor]) -> Tensor:
    summands = [*terms]
    return torch.stack(summands).sum() if summands else torch.zeros(())


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

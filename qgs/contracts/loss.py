"""Slots `losses` and `supervision`: what training minimises, and after which layers."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor

from qgs.contracts.component import Component, ComponentConfig
from qgs.types import LayerPrediction, Rendering, Views


class Loss(Component, torch.nn.Module):
    """(LayerPrediction, Rendering, target Views, input Views) -> a number to minimise, or several.

    A loss defines `term`; its `weight`, and the schedule of that, are applied here. Called for each
    supervised layer with a rendering from the target's cameras, and with all views that the
    prediction was made from; what is minimised is the sum of all terms, weighted by layer. Term
    names are unique within a recipe. Every term has a gradient in the prediction or in the
    rendering.

    renderings: which views a call needs, since training may render few at a time
        (`training.render_views`). "each": a term is a mean over views, so the loss is called with
        some views at a time and averaged. "all": all target views at once. "none": the loss reads
        no rendering; it gets all target views and a rendering of no views, (B, 0, ...).
    """

    slot: ClassVar[str] = "losses"
    renderings: ClassVar[Literal["each", "all", "none"]] = "all"
    scheduled: ClassVar[frozenset[str]] = frozenset({"weight"})
    reads_depths: ClassVar[bool] = False
    """Whether it reads `Views.depths`, which training then decodes where the data has them."""

    class Config(ComponentConfig):
        weight: float = Field(default=1.0, ge=0)
        """Factor of this loss in the objective; 0 leaves it out and takes no time."""

    config: Config

    @abstractmethod
    def term(
        self,
        prediction: LayerPrediction,
        rendering: Rendering,  # (B, V, ...); of no views where `renderings` is "none"
        target: Views,  # (B, V)
        inputs: Views,
    ) -> Tensor | Mapping[str, Tensor]:
        """The loss without its weight, averaged over scenes: 0-d, or several by name."""

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> dict[str, Tensor]:
        """The terms, weighted, by name: that of the component where there is one; none for 0."""
        weight = self.config.weight
        # A weight of 0 takes no time: the term is not even computed.
        if not weight:
            return {}
        # One term is called as its component, several have names of their own.
        found = self.term(prediction, rendering, target, inputs)
        terms = found if isinstance(found, Mapping) else {self.name: found}
        return {name: weight * term for name, term in terms.items()}


class Supervision(Component):
    """The supervised decoder layers and their weights."""

    slot: ClassVar[str] = "supervision"

    @abstractmethod
    def weights(self, rounds: Sequence[int] = ()) -> Mapping[int, float]:
        """Layer number to weight, ascending; the weights sum to 1.

        1 is the first layer; 0, the start, is the only one of a decoder of depth 0. rounds: numbers
        of the last layers of rounds of feedback, which are supervised too.
        """

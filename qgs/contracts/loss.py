"""Contracts of the slots `losses` and `supervision` (the decoder layers that losses apply to)."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import torch
from pydantic import NonNegativeFloat
from torch import Tensor

from qgs.contracts.component import Component, ComponentConfig
from qgs.types import LayerPrediction, Rendering, Views


class Loss(Component, torch.nn.Module):
    """Loss: (LayerPrediction, Rendering, target Views, input Views) -> one term or several.

    A subclass defines `term`; this class multiplies the result by `weight`, which may follow a
    schedule. Training calls the loss for each supervised layer. The rendering is from the target
    cameras; the input Views are all views that the model read. Training minimises the sum of all
    terms, weighted by layer. A term is one number to minimise; `history.jsonl` lists it under its
    name, which is unique within a recipe. Every term is differentiable in the prediction or in the
    rendering.

    renderings: the target views that one call needs; training may render few at a time
        (`training.render_views`). "each": a term is a mean over views, so training may call the
        loss with a few views at a time and average the results. "all": the loss needs all target
        views at once. "none": the loss reads no rendering; it gets all target views and a rendering
        of no views, (B, 0, ...).
    reads_depths: True if the loss reads `Views.depths`. Training then loads the data's depth maps,
        if any.
    """

    slot = "losses"
    renderings: ClassVar[Literal["each", "all", "none"]] = "all"
    scheduled = frozenset({"weight"})
    reads_depths: ClassVar[bool] = False

    class Config(ComponentConfig):
        weight: NonNegativeFloat = 1.0
        """Factor of this loss in the objective. A loss with weight 0 is not computed."""

    config: Config

    @abstractmethod
    def term(
        self,
        prediction: LayerPrediction,
        rendering: Rendering,  # (B, V, ...); of no views where `renderings` is "none"
        target: Views,  # (B, V)
        inputs: Views,
    ) -> Tensor | Mapping[str, Tensor]:
        """Return the unweighted loss, averaged over scenes: one 0-d tensor, or several by name."""

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> dict[str, Tensor]:
        """Return the weighted terms by name; an empty dict for weight 0.

        A single tensor from `term` gets the component's `name`.
        """
        weight = self.config.weight
        # A weight of 0 takes no time: the term is not even computed.
        if not weight:
            return {}
        # One term is called as its component, several have names of their own.
        found = self.term(prediction, rendering, target, inputs)
        terms = found if isinstance(found, Mapping) else {self.name: found}
        return {name: weight * term for name, term in terms.items()}


class Supervision(Component):
    """Choice of the decoder layers to which the losses apply, and the weights of these layers."""

    slot = "supervision"

    @abstractmethod
    def weights(self, rounds: Sequence[int] = ()) -> Mapping[int, float]:
        """Return the weight of each supervised layer by layer number; the weights sum to 1.

        Layer numbers start at 1 and are in ascending order. 0 is the initial state, which is
        supervised only in a decoder without layers.
        rounds: for each feedback round, the number of its last layer. These layers are supervised
            too.
        """

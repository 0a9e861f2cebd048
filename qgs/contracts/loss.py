"""Slots `losses` and `supervision`: what training minimises, and after which layers."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from qgs.contracts.component import Component
from qgs.types import LayerPrediction, Rendering, Views


class Loss(Component, torch.nn.Module):
    """(LayerPrediction, Rendering, target Views, input Views) -> named 0-d tensors, weighted.

    Called for each supervised layer with a rendering from the target's cameras, and with all views
    that the prediction was made from; what is minimised is the sum of all terms, weighted by layer.
    Term names are unique within a recipe. Every term has a gradient in the prediction or in the
    rendering.

    renderings: which views a call needs, since training may render few at a time
        (`training.render_views`). "each": a term is a mean over views, so the loss is called with
        some views at a time and averaged. "all": all target views at once. "none": the loss reads
        no rendering; it gets all target views and a rendering of no views, (B, 0, ...).
    """

    slot: ClassVar[str] = "losses"
    renderings: ClassVar[Literal["each", "all", "none"]] = "all"

    @abstractmethod
    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views, inputs: Views
    ) -> dict[str, Tensor]:
        """The terms of this loss, each multiplied by its weight and averaged over scenes."""


class Supervision(Component):
    """The supervised decoder layers and their weights."""

    slot: ClassVar[str] = "supervision"

    @abstractmethod
    def weights(self) -> Mapping[int, float]:
        """Layer number to weight, ascending; the weights sum to 1.

        1 is the first layer; 0, the start, is the only one of a decoder of depth 0.
        """

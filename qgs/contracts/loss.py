"""Slots `losses` and `supervision`: what training minimises, and at which layers."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Literal, TypeAlias

import torch
from torch import Tensor

from qgs.contracts.component import Component, ComponentConfig
from qgs.types import LayerPrediction, Rendering, Views

Renderings: TypeAlias = Literal["each", "all", "none"]


class Loss(Component, torch.nn.Module):
    """(LayerPrediction, Rendering, target Views) -> named 0-d tensors, already weighted.

    Called for each supervised layer; the objective is the sum of all terms, weighted by layer. The
    rendering shows the target's cameras. Term names are unique within a recipe. Every term has a
    gradient in the prediction or in the rendering.

    renderings: which renderings of the target views the terms need, where training may render few
    views at a time (`training.render_views`). "each": a term is the mean over target views of what
    it is for one of them alone; the loss is called with some of the views at a time. "all": those
    of all target views at once. "none": prediction and target suffice; the loss is called with all
    target views and a rendering of no views, (B, 0, ...).
    """

    slot: ClassVar[str] = "losses"
    renderings: ClassVar[Renderings] = "all"

    def __init__(self, config: ComponentConfig) -> None:
        torch.nn.Module.__init__(self)
        self.config = config

    @abstractmethod
    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        """The terms of this loss, each multiplied by its weight and averaged over scenes."""


class Supervision(Component):
    """The supervised decoder layers and their weights."""

    slot: ClassVar[str] = "supervision"

    def __init__(self, config: ComponentConfig) -> None:
        self.config = config

    @abstractmethod
    def weights(self) -> Mapping[int, float]:
        """Layer number (1 is the first, ascending) to weight; the weights sum to 1."""

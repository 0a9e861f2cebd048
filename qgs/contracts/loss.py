"""Slot `losses`: what training minimises."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import torch
from torch import Tensor

from qgs.contracts.component import Component, ComponentConfig
from qgs.types import LayerPrediction, Rendering, Views


class Loss(Component, torch.nn.Module):
    """(LayerPrediction, Rendering, target Views) -> named 0-d tensors, already weighted.

    Called once for each supervised layer; the objective is the sum of all terms, weighted by layer.
    The rendering shows the target's cameras. Term names are unique within a recipe.
    """

    slot: ClassVar[str] = "losses"

    def __init__(self, config: ComponentConfig) -> None:
        torch.nn.Module.__init__(self)
        self.config = config

    @abstractmethod
    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        """The terms of this loss, each multiplied by its weight and averaged over scenes."""

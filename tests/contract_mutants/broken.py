"""Components that cannot be built or called at all."""

from __future__ import annotations

import sys
from typing import ClassVar

import torch
from torch import Tensor

from qgs.components import MlpFeedForward
from qgs.contracts import Loss, ModelDims
from qgs.types import LayerPrediction, Rendering, Views


class CannotBeBuilt(MlpFeedForward):
    name: ClassVar[str] = "cannot_be_built"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        raise RuntimeError(f"no kernel for width {dims.width}")


class CannotBeCalled(MlpFeedForward):
    name: ClassVar[str] = "cannot_be_called"

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features @ torch.ones(3, 3))


class ForgetsToReturn(MlpFeedForward):
    name: ClassVar[str] = "forgets_to_return"

    def forward(self, features: Tensor) -> Tensor:
        super().forward(features)


class GivesNumbers(Loss):
    name: ClassVar[str] = "gives_numbers"
    renderings = "each"

    def forward(
        self, prediction: LayerPrediction, rendering: Rendering, target: Views
    ) -> dict[str, Tensor]:
        return {"error": (rendering.rgb - target.images).square().mean().item()}


class CannotBeCalledElsewhere(MlpFeedForward):
    name: ClassVar[str] = "cannot_be_called_elsewhere"

    def forward(self, features: Tensor) -> Tensor:
        if sys.argv[0] == "-c":
            raise RuntimeError("far from home")
        return super().forward(features)

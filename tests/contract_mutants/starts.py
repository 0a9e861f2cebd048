"""Components that start otherwise than they must: without a turn, or not twice alike."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor, nn

from qgs.components import GaussianHead, MlpFeedForward
from qgs.contracts import ModelDims


class StartsWithoutATurn(GaussianHead):
    """All its weights are zero at first, and so are its quaternions."""

    name: ClassVar[str] = "starts_without_a_turn"

    def __init__(self, config: GaussianHead.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        nn.init.zeros_(self.linear.weight)


class DrawsInTheOrderOfASet(MlpFeedForward):
    """Texts hash otherwise in every process."""

    name: ClassVar[str] = "draws_in_the_order_of_a_set"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        names = {"center", "radius", "colour", "scale", "turn", "depth", "normal", "opacity"}
        self.parts = nn.ModuleDict({name: nn.Linear(dims.width, dims.width) for name in names})

    def forward(self, features: Tensor) -> Tensor:
        update = super().forward(features)
        for name in sorted(self.parts):
            update = update + self.parts[name](update)
        return update

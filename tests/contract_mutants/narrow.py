"""One number for each query, and a look for a field by `in`."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from qgs.contracts import Centers, ModelDims
from qgs.types import QueryState


class ShiftsByOneNumber(Centers):
    """A width of 1 takes a product that depends on where in memory the numbers lie."""

    name: ClassVar[str] = "shifts_by_one_number"

    def __init__(self, config: Centers.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.shift = nn.Linear(dims.width, 1)

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        return torch.tanh(offsets) + self.shift(state.features)[:, :, None]


class LooksForAFieldOfTheState(Centers):
    name: ClassVar[str] = "looks_for_a_field_of_the_state"

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        return torch.tanh(offsets) + float("someones.field" in state)

"""Slot `centers`: where the Gaussians of a query stand."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from torch import Tensor

from qgs.contracts.component import ModelComponent
from qgs.types import QueryState


class Centers(ModelComponent):
    """(raw offsets (B, N, K, 3), QueryState) -> means (B, N, K, 3), world frame, float32.

    The state is the one after the last refinement of the decoded layer.
    """

    slot: ClassVar[str] = "centers"

    @abstractmethod
    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """World-frame means."""

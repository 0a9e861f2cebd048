"""Slot `centers`: where the Gaussians of a query stand."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from torch import Tensor

from qgs.contracts.component import ModelComponent
from qgs.types import QueryState


class Centers(ModelComponent):
    """(raw offsets (B, N, K, 3), QueryState) -> means (B, N, K, 3), world frame, float32.

    The state is the one after the refinement of the decoded layer. Means are finite for finite
    offsets. Raises KeyError for a field the state lacks, which the composer rules out through
    `requires`.
    """

    slot: ClassVar[str] = "centers"

    @abstractmethod
    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """World-frame means."""

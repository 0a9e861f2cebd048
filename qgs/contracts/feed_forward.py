"""Slot `decoder.feed_forward`: each query on its own."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from torch import Tensor

from qgs.contracts.component import ModelComponent


class FeedForward(ModelComponent):
    """Features (B, N, D) -> update (B, N, D); norm inside, LayerScale and residual outside.

    Sees each query by itself. Raises RuntimeError (torch's) for features of another width.
    """

    slot: ClassVar[str] = "feed_forward"

    @abstractmethod
    def forward(self, features: Tensor) -> Tensor:
        """The update of the query features, before LayerScale."""

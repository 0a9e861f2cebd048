"""Slot `queries`: the learned state that every scene starts from."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from qgs.contracts.component import ModelComponent
from qgs.types import QueryState, SpatialSupport


class Queries(ModelComponent):
    """Batch size -> QueryState of N queries: features (B, N, D) and the fields in `provides`.

    The initial state does not depend on the photos and is shared by all scenes. Spatial fields are
    float32 in the world frame, (B, N, ...).
    """

    slot: ClassVar[str] = "queries"

    @property
    @abstractmethod
    def count(self) -> int:
        """N, the number of queries."""

    @abstractmethod
    def forward(self, batch_size: int) -> QueryState:
        """The initial state, expanded to `batch_size` scenes."""

    def support(self, state: QueryState) -> SpatialSupport | None:
        """Where each query of `state` looks; None for queries without a place in space."""
        return None

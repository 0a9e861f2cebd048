"""Slot `decoder.refinement`: the spatial state moves after each layer."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from qgs.contracts.component import ModelComponent
from qgs.types import QueryState


class Refinement(ModelComponent):
    """QueryState -> QueryState with refined fields; features are passed on as they are.

    Runs at the end of each decoder layer. Layers with the same component and equal options share
    one module, as the published heads do, unless the class sets `shared_by_layers` to False.
    """

    slot: ClassVar[str] = "refinement"
    shared_by_layers: ClassVar[bool] = True

    @abstractmethod
    def forward(self, state: QueryState) -> QueryState:
        """A new state; the one given stays as it was."""

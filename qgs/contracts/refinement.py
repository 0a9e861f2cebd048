"""Slot `decoder.refinement`: the spatial state moves after each layer."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from qgs.contracts.component import ModelComponent
from qgs.types import QueryState


class Refinement(ModelComponent):
    """QueryState -> QueryState with refined fields; features are passed on as they are.

    Runs at the end of each decoder layer. Layers whose options are equal share one module.
    """

    slot: ClassVar[str] = "refinement"

    @abstractmethod
    def forward(self, state: QueryState) -> QueryState:
        """A new state; the one given stays as it was."""

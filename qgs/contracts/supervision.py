"""Slot `supervision`: which decoder layers are decoded, rendered and weighted."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from qgs.contracts.component import Component, ComponentConfig


class Supervision(Component):
    """The supervised decoder layers and their weights."""

    slot: ClassVar[str] = "supervision"

    def __init__(self, config: ComponentConfig) -> None:
        self.config = config

    @abstractmethod
    def weights(self) -> Mapping[int, float]:
        """Layer number (1 is the first, ascending) to weight; the weights sum to 1."""

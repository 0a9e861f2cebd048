"""Slot `head`: query features to Gaussian attributes."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import torch

from qgs.contracts.component import ModelComponent
from qgs.types import GaussianAttributes, QueryState


class Head(ModelComponent):
    """QueryState -> GaussianAttributes of K Gaussians per query (shapes there).

    Scales are positive, quaternions unit (w x y z), opacities in (0, 1), colours in [0, 1];
    `offsets` stay raw. With initial parameters too, for features other than zero.
    """

    slot: ClassVar[str] = "head"

    @property
    @abstractmethod
    def gaussians_per_query(self) -> int:
        """K, the Gaussians decoded from each query."""

    @abstractmethod
    def forward(self, state: QueryState) -> GaussianAttributes:
        """Decode the attributes of every Gaussian but its mean."""

    def decays(self, name: str, parameter: torch.nn.Parameter) -> bool:
        """No weight decay on a head (TokenGS release)."""
        return False

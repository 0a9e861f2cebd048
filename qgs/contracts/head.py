"""Slots `head` and `centers`: from query features to Gaussians."""

from abc import abstractmethod
from typing import ClassVar

import torch
from torch import Tensor

from qgs.contracts.component import Fields, FieldSpec, ModelComponent
from qgs.types import GaussianAttributes, QueryState

GAUSSIAN_FIELDS: Fields = {
    "gaussians.sh": FieldSpec(("C", 3)),
    "gaussians.features": FieldSpec(("F",)),
}
"""Optional outputs of a head; the other attributes are those of every Gaussian."""


class Head(ModelComponent):
    """QueryState -> GaussianAttributes of K Gaussians per query, in the ranges given there.

    They hold with initial parameters too, for features other than zero. A head that gives `sh` or
    `features` provides those of GAUSSIAN_FIELDS, so that losses which read them can require them.
    """

    slot: ClassVar[str] = "head"

    @property
    def gaussians_per_query(self) -> int:
        """K, the Gaussians decoded from each query: the option of this name, if there is one."""
        return getattr(self.config, "gaussians_per_query")  # noqa: B009 (an option of subclasses)

    @abstractmethod
    def forward(self, state: QueryState) -> GaussianAttributes:
        """The attributes of all Gaussians, without their means."""

    def decays(self, name: str, parameter: torch.nn.Parameter) -> bool:
        """No weight decay on a head (TokenGS release)."""
        return False


class Centers(ModelComponent):
    """(raw offsets (B, N, K, 3), QueryState) -> means (B, N, K, 3), world frame, float32.

    The state is that after the refinement of the decoded layer. Means are finite for finite
    offsets. Raises KeyError for a field that the state lacks (the composer rules this out).
    """

    slot: ClassVar[str] = "centers"

    @abstractmethod
    def forward(
        self,
        offsets: Tensor,  # (B, N, K, 3) raw
        state: QueryState,
    ) -> Tensor:
        """World-frame means."""

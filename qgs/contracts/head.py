"""Contracts of the slots `head` and `centers`, which turn query features into Gaussians."""

from abc import abstractmethod

import torch
from torch import Tensor

from qgs.contracts.component import Fields, FieldSpec, ModelComponent
from qgs.types import GaussianAttributes, QueryState

GAUSSIAN_FIELDS: Fields = {
    "gaussians.sh": FieldSpec(("C", 3)),
    "gaussians.features": FieldSpec(("F",)),
}
"""Optional outputs of a head. It must output all other attributes of `GaussianAttributes`."""


class Head(ModelComponent):
    """Head: QueryState -> GaussianAttributes of K Gaussians per query, in their valid ranges.

    `GaussianAttributes` gives these ranges. An untrained head keeps these ranges too if the
    features are nonzero. A head that outputs `sh` or `features` declares them in `writes`, see
    GAUSSIAN_FIELDS, so that losses can require them.
    """

    slot = "head"

    @property
    def gaussians_per_query(self) -> int:
        """Number K of Gaussians per query; by default the option `gaussians_per_query`."""
        return getattr(self.config, "gaussians_per_query")  # noqa: B009 (an option of subclasses)

    @abstractmethod
    def forward(self, state: QueryState) -> GaussianAttributes:
        """Return all attributes of the Gaussians except their means."""

    def decays(self, name: str, parameter: torch.nn.Parameter) -> bool:
        """Return whether weight decay applies to `parameter`; default: False (TokenGS release)."""
        return False


class Centers(ModelComponent):
    """Centers: (raw offsets (B, N, K, 3), QueryState) -> world-frame means (B, N, K, 3) in float32.

    B, N and K are scenes, queries and Gaussians per query. The state is the output of a decoder
    layer after the layer's refinement. Finite offsets give finite means. Raises KeyError for a
    field that the state lacks; model construction prevents this by checking `reads`.
    """

    slot = "centers"

    @abstractmethod
    def forward(
        self,
        offsets: Tensor,  # (B, N, K, 3) raw
        state: QueryState,
    ) -> Tensor:
        """Return the means (B, N, K, 3) of all Gaussians in the world frame."""

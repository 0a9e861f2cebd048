"""Slot `queries`: the learned state that every scene starts from."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from qgs.contracts.component import ModelComponent
from qgs.types import QueryState, SpatialSupport

GROWTH_NOISE = 0.01
"""Standard deviation of the noise added to the copy of a query (LocusGS release)."""


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

    def resized(
        self, learned: Mapping[str, Tensor], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """A state dict for these queries, made of one `learned` with another number of queries.

        learned: on the CPU; shapes differ from ours in the first axis alone, the queries.
        Shrinking keeps the first N. Growing keeps all; query i beyond them copies query i modulo
        their number, plus noise of N(0, 0.01) on all parameters (LocusGS release, finetuning).
        """
        own = {name: values.shape for name, values in self.state_dict().items()}
        return {
            name: values if values.shape == own[name] else _resized(values, own[name][0], generator)
            for name, values in learned.items()
        }

    def support(self, state: QueryState) -> SpatialSupport | None:
        """Where each query of `state` looks; None for queries without a position."""
        return None


def _resized(values: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """The first `count` items of `values`, or all of them and then noisy copies in turn."""
    if count <= len(values):
        return values[:count]
    copied = values[torch.arange(len(values), count) % len(values)]
    noise = torch.randn(copied.shape, generator=generator, dtype=copied.dtype)
    return torch.cat([values, copied + GROWTH_NOISE * noise])

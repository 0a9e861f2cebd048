"""Slot `queries`: the state that a scene starts from."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from qgs.contracts.component import ModelComponent
from qgs.types import ImageMemory, QueryState, SpatialSupport, Views

GROWTH_NOISE = 0.01
"""Standard deviation of the noise added to the copy of a query (LocusGS release)."""


class Queries(ModelComponent):
    """(ImageMemory, Views) -> QueryState of N queries: features (B, N, D), fields in `writes`.

    Spatial fields are float32 in the world frame, (B, N, ...). Queries that read the memory say
    which parts of it they need in `reads`, as `memory.features`. Scenes are independent; a
    state whose scenes have different numbers of queries has a mask.

    reads_cameras: whether they read `views.cameras`. Those that do not may be given `Photos`.
    """

    slot: ClassVar[str] = "queries"
    reads_cameras: ClassVar[bool] = True

    @property
    def count(self) -> int | None:
        """N, the number of queries: the option `count`; None where it depends on the views."""
        return getattr(self.config, "count", None)

    @abstractmethod
    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        """The initial state of every scene."""

    def resized(
        self, learned: Mapping[str, Tensor], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """A state dict for these queries, made of one `learned` with another number of queries.

        learned: on the CPU; shapes differ from ours in the first axis alone, the queries.
        Shrinking keeps the first N. Growing keeps all; each new query i copies query i modulo
        their number, plus noise of N(0, 0.01) on all parameters (LocusGS release, finetuning).
        """
        own = {name: values.shape for name, values in self.state_dict().items()}
        return {
            name: values if values.shape == own[name] else _resized(values, own[name][0], generator)
            for name, values in learned.items()
        }

    def support(self, state: QueryState) -> SpatialSupport | None:
        """Space in which each query of `state` looks; None for queries without a position."""
        return None


class LearnedQueries(Queries):
    """Queries that start from parameters alone: the same in all scenes, whatever the photos."""

    reads_cameras = False

    @property
    def count(self) -> int:
        """N, the number of queries: the option `count`."""
        return getattr(self.config, "count")  # noqa: B009 (an option of subclasses)

    @abstractmethod
    def start(self, batch_size: int) -> QueryState:
        """The initial state, expanded to `batch_size` scenes."""

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        """The initial state of as many scenes as the memory has."""
        return self.start(memory.features.shape[0])


def _resized(values: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """The first `count` items of `values`, or all of them and then noisy copies in turn."""
    if count <= len(values):
        return values[:count]
    # In turn, so that every learned query has as many descendants as the others.
    copied = values[torch.arange(len(values), count) % len(values)]
    # Exact copies would have equal gradients, and stay copies.
    noise = torch.randn(copied.shape, generator=generator, dtype=copied.dtype)
    return torch.cat([values, copied + GROWTH_NOISE * noise])

"""Contract of the slot `queries`, which makes the initial query state of a scene."""

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
    """Queries: (ImageMemory, Views) -> QueryState of N queries.

    The state has features (B, N, D), for B scenes and width D, and the fields in `writes`. Spatial
    fields are (B, N, ...) float32 in the world frame. A component that reads the memory lists the
    parts that it reads in `reads`, such as `memory.features`. The state of a scene does not depend
    on other scenes of the batch. If scenes have different numbers of queries, the state has a mask.

    reads_cameras: True if the component reads `views.cameras`. If False, it accepts `Photos` too.
    """

    slot = "queries"
    reads_cameras: ClassVar[bool] = True

    @property
    def count(self) -> int | None:
        """Number N of queries, by default the option `count`; None if N depends on the views."""
        return getattr(self.config, "count", None)

    @property
    def trained_counts(self) -> tuple[int, int] | None:
        """Least and largest number of queries in a training step; None if it is always the same.

        A trained model may have any number between them.
        """
        return None

    @abstractmethod
    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        """Return the initial state of every scene."""

    def resized(
        self, learned: Mapping[str, Tensor], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Return a state dict for N queries, made from the state dict of more or fewer queries.

        learned: the state dict of n queries, on the CPU. Its shapes differ from the new ones only
            in the first axis, the queries. If N is smaller than n, the first N queries are kept. If
            N is larger, all n queries are kept; each further query i copies query i modulo n and
            adds noise of standard deviation 0.01 to all parameters (LocusGS release, finetuning).
        """
        own = {name: values.shape for name, values in self.state_dict().items()}
        return {
            name: values if values.shape == own[name] else _resized(values, own[name][0], generator)
            for name, values in learned.items()
        }

    def support(self, state: QueryState) -> SpatialSupport | None:
        """Return the ellipsoid that each query covers; None for queries without a position."""
        return None


class LearnedQueries(Queries):
    """Queries whose initial state depends only on parameters, so it is the same in all scenes."""

    reads_cameras = False
    count: int  # pyright: ignore[reportIncompatibleVariableOverride]
    """Number N of queries: the option `count`, which subclasses have."""

    @abstractmethod
    def start(self, batch_size: int) -> QueryState:
        """Return the initial state for `batch_size` scenes, equal for all of them."""

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        """Return the initial state for as many scenes as the memory has."""
        return self.start(len(memory.features))


def _resized(values: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Cut `values` to `count` items along the first axis, or append noisy copies of the items."""
    if count <= len(values):
        return values[:count]
    # In turn, so that all learned queries get equally many copies.
    copied = values[torch.arange(len(values), count) % len(values)]
    # Exact copies would have equal gradients, and stay copies.
    noise = torch.randn(copied.shape, generator=generator, dtype=copied.dtype)
    return torch.cat([values, copied + GROWTH_NOISE * noise])

"""`qgs/latent`: learned queries without a position (TokenGS)."""

import torch
from pydantic import Field
from torch import nn

from qgs.contracts import ComponentConfig, LearnedQueries, ModelDims
from qgs.types import QueryState


class LatentQueries(LearnedQueries):
    """N learned vectors, shared by all scenes, without a position."""

    name = "latent"

    class Config(ComponentConfig):
        count: int = Field(default=4096, ge=1)
        """N, the number of queries."""
        std: float = Field(default=0.01, ge=0)
        """Standard deviation of the normal distribution that the features start from."""

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        # Different from the start: equal queries would get equal gradients and stay equal.
        self.features = nn.Parameter(torch.randn(config.count, dims.width) * config.std)

    def start(self, batch_size: int) -> QueryState:
        return QueryState(features=self.features.expand(batch_size, -1, -1))

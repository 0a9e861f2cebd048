"""Queries of scenes that move: static ones, and others of the moment asked for (TokenGS 2026.6)."""

from collections.abc import Iterable
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn

from qgs.components.blocks import NORM_EPS, SelfAttentionCore
from qgs.components.times import TimeEmbedding
from qgs.contracts import (
    AttentionWeights,
    ComponentConfig,
    Fields,
    FieldSpec,
    ModelDims,
    Problem,
    Queries,
    RecipeContext,
    SelfAttention,
)
from qgs.types import ImageMemory, QueryState, Views

MOVES = "dynamic.moves"
"""Whether a query is of the moment that is asked for: True for the dynamic ones."""
_FIELDS: Fields = {MOVES: FieldSpec((), torch.bool)}


class DynamicQueries(Queries):
    """N learned vectors, of which the last ones also know the time that is asked for."""

    name: ClassVar[str] = "dynamic"

    class Config(ComponentConfig):
        count: int = Field(default=1280, ge=1)
        """N, the number of queries, static and dynamic (TokenGS: 1024 and 256)."""
        dynamic: int = Field(default=256, ge=0)
        """Dynamic ones among them, the last; 0 gives all of them the time."""
        std: float = Field(default=0.02, ge=0)
        """Standard deviation of the normal distribution that the features start from."""
        time_channels: int = Field(default=2, ge=0, multiple_of=2)
        """Numbers that a time is embedded as; 0 for queries that know no time."""
        patch_size: int = Field(default=8, ge=1)
        """Side of the patches that embed the time, as published those of the encoder."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        fixed, moving = config.count - config.dynamic, config.dynamic
        self.features = nn.Parameter(torch.randn(fixed, dims.width) * config.std)
        if moving:
            self.dynamic = nn.Parameter(torch.randn(moving, dims.width) * config.std)
        if config.time_channels:
            self.time_embedding = TimeEmbedding(config.time_channels, dims.width, config.patch_size)

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        if config.dynamic >= config.count:
            yield Problem(
                "dynamic",
                f"{config.dynamic} dynamic queries leave none of {config.count} to be static",
                f"set dynamic to {config.count - 1} or less, or raise count",
            )

    @classmethod
    def provides(cls, config: ComponentConfig) -> Fields:
        return _FIELDS

    @property
    def count(self) -> int:
        """N, static and dynamic."""
        return self.config.count

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        """The field `dynamic.moves` (B, N). Raises ValueError for views without a target time."""
        config, batch = self.config, len(memory.features)
        parts: list[Tensor] = [self.features, *([self.dynamic] if config.dynamic else [])]
        x_BND = torch.cat(parts).expand(batch, -1, -1)
        first = len(self.features) if config.dynamic else 0
        moves_N = torch.arange(config.count, device=x_BND.device) >= first
        if config.time_channels:
            if views.target_time is None:
                raise ValueError(
                    "qgs/dynamic queries need the time that is asked for: give the input views a "
                    "target_time (B, 1), or set model.queries.time_channels to 0"
                )
            x_BND = x_BND + moves_N[:, None] * self.time_embedding(views.target_time)
        return QueryState(x_BND, {MOVES: moves_N.expand(batch, -1)})


class BlockCausalSelfAttention(SelfAttention):
    """Dynamic queries read all queries, static ones the static ones alone."""

    name: ClassVar[str] = "block_causal"

    class Config(ComponentConfig):
        norm_eps: float = Field(default=NORM_EPS, gt=0)
        """Added to the variance by every LayerNorm."""

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.norm = nn.LayerNorm(dims.width, config.norm_eps)
        self.attention = SelfAttentionCore(dims.width, dims.heads, config.norm_eps)

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        return _FIELDS

    def forward(self, state: QueryState) -> Tensor:
        return self.attention(self.norm(state.features), _readable(state))

    def explain(self, state: QueryState, queries: Tensor) -> AttentionWeights:
        return self.attention.explain(self.norm(state.features), queries, _readable(state))


def _readable(state: QueryState) -> Tensor:
    """(B, N, N): which queries (rows) may read which."""
    moves_BN = state[MOVES]
    readable_BNN = moves_BN[:, :, None] | ~moves_BN[:, None]
    return readable_BNN if state.mask is None else readable_BNN & state.mask[:, None]

"""Queries for moving scenes: static queries, and dynamic queries for the requested time.

The queries follow TokenGS 2026.6.
"""

from collections.abc import Iterable

import torch
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt
from torch import Tensor, nn

from qgs.containers import map_tensors
from qgs.contracts import (
    ComponentConfig,
    Fields,
    FieldSpec,
    ModelDims,
    Objective,
    Outcome,
    Passes,
    Problem,
    Queries,
    RecipeContext,
)
from qgs.tokengs.decoder import ContentSelfAttention
from qgs.types import ImageMemory, LayerPrediction, Prediction, QueryState, Views
from qgs_zoo.parts import mean_outcome
from qgs_zoo.tokengs2026.multiscale import TimeEmbedding, without_times

MOVES = "dynamic.moves"
"""Name of the field (B, N), bool: True for dynamic queries, which depend on the requested time."""
_FIELDS: Fields = {MOVES: FieldSpec((), torch.bool)}


class DynamicQueries(Queries):
    """N learned queries: static queries first, then dynamic queries.

    An embedding of the time for which the scene is requested is added to dynamic queries.
    """

    name = "dynamic"
    reads_cameras = False

    class Config(ComponentConfig):
        count: PositiveInt = 1280
        """N, the number of static and dynamic queries together (TokenGS: 1024 static + 256
        dynamic)."""
        dynamic: NonNegativeInt = 256
        """Number of dynamic queries, which are the last of the N queries. 0 marks no query as
        dynamic, and adds the embedding of the time to all queries."""
        std: NonNegativeFloat = 0.02
        """Standard deviation of the queries' initial features, which are normally distributed."""
        time_channels: int = Field(default=2, ge=0, multiple_of=2)
        """Number of channels that encode the requested time. 0 ignores the time."""
        patch_size: PositiveInt = 8
        """Side P of the convolution, P x P pixels, that embeds the time. Its input is a patch in
        which every pixel holds the encoded time. The release uses the encoder's patch size."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        fixed = config.count - config.dynamic
        moving = config.dynamic
        self.features = nn.Parameter(torch.randn(fixed, dims.width) * config.std)
        if moving:
            self.dynamic = nn.Parameter(torch.randn(moving, dims.width) * config.std)
        if config.time_channels:
            self.time_embedding = TimeEmbedding(config.time_channels, dims.width, config.patch_size)

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        yield from without_times(config.time_channels, context)
        if config.dynamic >= config.count:
            yield Problem(
                "dynamic",
                f"{config.dynamic} dynamic queries of {config.count} leave no static ones",
                f"set dynamic to {config.count - 1} or less, or raise count",
            )

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        return _FIELDS if config.dynamic else {}

    def forward(self, memory: ImageMemory, views: Views) -> QueryState:
        """Return initial queries; the field `dynamic.moves` (B, N) marks dynamic queries, if any.

        Raises ValueError for views without a target time, except with `time_channels: 0`.
        """
        config = self.config
        batch = len(memory.features)
        moving = self.dynamic if config.dynamic else self.features[:0]
        x_BND = torch.cat([self.features, moving]).expand(batch, -1, -1)
        # Dynamic queries come last, as in the released weights.
        first = len(self.features) if config.dynamic else 0
        moves_N = torch.arange(config.count, device=x_BND.device) >= first
        if config.time_channels:
            if views.target_time is None:
                raise ValueError(
                    "tokengs2026/dynamic queries need the requested time: use target photos of "
                    "one time, give the input views a target_time (B, 1), or set "
                    "model.queries.time_channels to 0"
                )
            x_BND = x_BND + moves_N[:, None] * self.time_embedding(views.target_time)
        return QueryState(x_BND, {MOVES: moves_N.expand(batch, -1)} if config.dynamic else {})


class BlockCausalSelfAttention(ContentSelfAttention):
    """Self-attention in which static queries read static queries, and dynamic queries read all.

    So static queries do not depend on the requested time.
    """

    name = "block_causal"
    reads = _FIELDS

    def read(self, state: QueryState) -> tuple[Tensor, Tensor]:
        features_BND, mask = super().read(state)
        moves_BN = state[MOVES]
        # Static queries read only static ones, so that they are the same at all times.
        readable_BNN = moves_BN[:, :, None] | ~moves_BN[:, None]
        return features_BND, readable_BNN if mask is None else readable_BNN & mask[:, None]


class DynamicObjective(Objective):
    """Objective of one prediction: its losses, plus those of its dynamic Gaussians rendered alone.

    Dynamic Gaussians are the Gaussians of dynamic queries.
    """

    name = "dynamic"
    reads = _FIELDS
    scheduled = frozenset({"weight"})
    # Input photos show other times than the reconstructed one.
    judges_inputs = False

    class Config(ComponentConfig):
        weight: NonNegativeFloat = 0.3
        """Weight of the losses of dynamic Gaussians rendered alone. 0 skips these losses. TokenGS
        uses 0.3 for 5,000 steps, then a decay to 0 over 10,000 steps."""

    config: Config

    def forward(self, inputs: Views, targets: Views, passes: Passes) -> Outcome:
        """Return the losses of all Gaussians, plus the term `dynamic`.

        This term is `weight` times the sum of the losses of dynamic Gaussians rendered alone.
        """
        prediction = passes.predict(inputs)
        whole = passes.judge(prediction, targets, inputs)
        added = torch.zeros_like(whole.total)
        if self.config.weight:
            layers = {number: _alone(layer) for number, layer in prediction.layers.items()}
            # The whole prediction covers the static scene; the moving part is judged again alone.
            last = layers[max(layers)]
            alone = Prediction(last.gaussians, last.state, layers)
            added = self.config.weight * passes.judge(alone, targets, inputs).total
        return mean_outcome([whole], dynamic=added)


def _alone(layer: LayerPrediction) -> LayerPrediction:
    """Return a layer's prediction with only its dynamic queries and their Gaussians.

    The dynamic queries must be the same in all scenes of the batch.
    """
    moves_N = layer.state[MOVES][0]
    each = layer.gaussians.count // len(moves_N)
    of_gaussians = moves_N.repeat_interleave(each)
    return LayerPrediction(
        map_tensors(lambda x: x[:, of_gaussians], layer.gaussians),
        map_tensors(lambda x: x[:, moves_N], layer.state),
    )

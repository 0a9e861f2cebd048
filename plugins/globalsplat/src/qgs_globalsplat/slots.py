"""`globalsplat/slots`: learned tokens, each as two streams, one of geometry, one of texture."""

from collections.abc import Iterable

import torch
from pydantic import Field
from torch import Tensor, nn

from qgs.contracts import (
    ComponentConfig,
    Fields,
    FieldSpec,
    LearnedQueries,
    ModelDims,
    Problem,
    RecipeContext,
)
from qgs.geometry.precision import at_least_float32
from qgs.types import QueryState

TEXTURE = "globalsplat.texture"
"""State field (B, N, D): the stream of texture; that of geometry are the features."""

TEXTURE_FIELD: Fields = {TEXTURE: FieldSpec(("D",))}


class SlotQueries(LearnedQueries):
    """N learned tokens, of which the last `extra` decode no Gaussians: the mask leaves them out.

    Geometry = Linear(LayerNorm(token)), texture = another Linear(LayerNorm(token)).
    """

    name = "slots"
    writes = TEXTURE_FIELD

    class Config(ComponentConfig):
        """Defaults are GlobalSplat's."""

        count: int = Field(default=2057, ge=1)
        """N, the number of all tokens."""
        extra: int = Field(default=9, ge=0)
        """Tokens among them that decode no Gaussians (4 auxiliary, 1 of scale, 4 registers)."""
        std: float = Field(default=0.02, gt=0)
        """Standard deviation of the normal distribution that the tokens start from."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        width = dims.width
        self.slots = nn.Parameter(torch.randn(config.count - config.extra, width) * config.std)
        extra = torch.randn(config.extra, width) * config.std
        self.extra = nn.Parameter(extra) if config.extra else None
        self.geometry = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width))
        self.texture = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width))

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Tokens of which none decodes Gaussians."""
        if config.extra >= config.count:
            reason = f"all {config.count} tokens are extra ones, which decode no Gaussians"
            yield Problem("extra", reason, f"write at most {config.count - 1}, or raise `count`")

    def start(self, batch_size: int) -> QueryState:
        """The two streams of all tokens, in every scene alike."""
        tokens_ND = self.slots if self.extra is None else torch.cat([self.slots, self.extra])
        streams = (self.geometry(tokens_ND), at_least_float32(self.texture(tokens_ND)))
        geometry_BND, texture_BND = (x.expand(batch_size, -1, -1) for x in streams)
        return QueryState(geometry_BND, {TEXTURE: texture_BND}, self._mask(batch_size))

    def _mask(self, batch_size: int) -> Tensor | None:
        if self.extra is None:
            return None
        places = torch.arange(self.config.count, device=self.slots.device)
        return (places < len(self.slots)).expand(batch_size, -1)

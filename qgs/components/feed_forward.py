"""`qgs/mlp`: the MLP of a decoder layer (TokenGS)."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field
from torch import Tensor, nn

from qgs.components.blocks import NORM_EPS, Mlp
from qgs.contracts import ComponentConfig, FeedForward, ModelDims


class MlpFeedForward(FeedForward):
    """LayerNorm, D -> ratio*D -> D with GELU."""

    name: ClassVar[str] = "mlp"

    class Config(ComponentConfig):
        """ratio: hidden width, rounded down, over D. norm_eps: of the LayerNorm."""

        ratio: float = Field(default=4.0, ge=1)
        norm_eps: float = Field(default=NORM_EPS, gt=0)

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.norm = nn.LayerNorm(dims.width, config.norm_eps)
        self.mlp = Mlp(dims.width, int(config.ratio * dims.width), dims.width)

    def forward(self, features: Tensor) -> Tensor:
        """The update (B, N, D)."""
        return self.mlp(self.norm(features))

"""`locus/anchor_aware`: self-attention of queries, with an embedding of their anchor centres."""

import math
from typing import Literal

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat
from torch import Tensor

from qgs.contracts import ModelDims
from qgs.precision import full_precision
from qgs.tokengs import ContentSelfAttention, Mlp
from qgs.types import QueryState
from qgs_locus.fields import CENTER, CENTER_FIELD


@full_precision
def sine_embedding(
    position: Tensor, features: int, temperature: float, divisor_eps: float
) -> Tensor:
    """Embed positions (..., 3) in [-1, 1] as sines and cosines (..., 3 * features).

    Each coordinate is mapped to an angle in [0, 2 pi]. For each frequency i, the angle is divided
    by temperature^(2i / features) + divisor_eps. Results are ordered by axis, then by frequency,
    with the sine before the cosine (LocusGS release).
    """
    # Each sine shares its frequency with a cosine.
    half = torch.arange(features // 2, dtype=position.dtype, device=position.device)
    divisor = temperature ** (2 * half / features) + divisor_eps
    angle = ((position + 1) * math.pi)[..., None] / divisor
    return torch.stack([angle.sin(), angle.cos()], -1).flatten(-3)


class AnchorAwareSelfAttention(ContentSelfAttention):
    """Self-attention over x + p, with p = MLP(sine embedding of the anchor centre).

    x are the query's features. Queries, keys and values are computed from x + p, but p is not added
    to the features of the next layer. This is equation (5) of the plugin's README.
    """

    name = "anchor_aware"
    reads = CENTER_FIELD

    class Config(ContentSelfAttention.Config):
        position: Literal["tanh", "raw"] = "tanh"
        """Embed tanh of the centre ("tanh", LocusGS release) or the centre itself ("raw",
        paper)."""
        features: int = Field(default=128, ge=2, multiple_of=2)
        """Number of sines plus number of cosines for each axis."""
        temperature: PositiveFloat = 10_000.0
        """Approximate ratio of the longest to the shortest wavelength of the sines."""
        divisor_eps: NonNegativeFloat = 1e-6
        """Small number that is added to the divisor of each sine's argument (LocusGS release)."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.position_mlp = Mlp(3 * config.features, dims.width, dims.width)

    def read(self, state: QueryState) -> tuple[Tensor, Tensor | None]:
        """Read features x + p, with p the embedding of the anchor centres."""
        position_BN3 = state[CENTER]
        c = self.config
        # The sines expect [-1, 1], but centres are unbounded.
        if c.position == "tanh":
            position_BN3 = torch.tanh(position_BN3)
        sines = sine_embedding(position_BN3, c.features, c.temperature, c.divisor_eps)
        return self.norm(state.features + self.position_mlp(sines)), state.mask

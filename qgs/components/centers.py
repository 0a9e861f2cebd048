"""`qgs/free`: a Gaussian stands where the head says, anywhere in the world (TokenGS)."""

from __future__ import annotations

from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor

from qgs.components.position import posact
from qgs.contracts import Centers, ComponentConfig
from qgs.types import QueryState


class FreeCenters(Centers):
    """mean = posact(offset) + (0, 0, z_offset)."""

    name: ClassVar[str] = "free"

    class Config(ComponentConfig):
        """z_offset: world units; 1 in TokenGS, 0 in LocusGS's free-centre ablation.

        input_limit, output_limit: clamps of posact, None for none (LocusGS release: 100 and 1000;
        TokenGS release: none).
        """

        z_offset: float = 1.0
        input_limit: float | None = Field(default=100.0, gt=0)
        output_limit: float | None = Field(default=1000.0, gt=0)

    config: Config

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """(B, N, K, 3) -> (B, N, K, 3)."""
        means = posact(offsets, self.config.input_limit, self.config.output_limit)
        return means + torch.tensor([0.0, 0.0, self.config.z_offset]).to(means)

"""`c3g/head`: from a query to its Gaussian, one by default (C3G)."""

import torch
import torch.nn.functional as F
from einops import rearrange
from pydantic import Field
from torch import Tensor, nn

from qgs.contracts import ComponentConfig, Head, ModelDims
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.precision import at_least_float32
from qgs.tokengs import NORM_EPS
from qgs.types import GaussianAttributes, QueryState

CHANNELS = (3, 1, 3, 4, 3)
"""Per Gaussian: position, opacity, scale, rotation, harmonic of degree 0 (C3G release)."""


class C3GHead(Head):
    """LayerNorm, then D -> K * 14 linear and the published activations in float32."""

    name = "head"

    class Config(ComponentConfig):
        gaussians_per_query: int = Field(default=1, ge=1)
        """K, the Gaussians decoded from each query."""
        scale_unit: float = Field(default=0.001, gt=0)
        """What the softplus of a raw scale is multiplied by, world units."""
        quat_eps: float = Field(default=1e-8, gt=0)
        """Least length that a raw quaternion is divided by."""
        norm_eps: float = Field(default=NORM_EPS, gt=0)
        """Added to the variance by the LayerNorm."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.norm = nn.LayerNorm(dims.width, config.norm_eps)
        self.linear = nn.Linear(dims.width, config.gaussians_per_query * sum(CHANNELS))

    def decays(self, name: str, parameter: nn.Parameter) -> bool:
        """Weight decay on all (C3G release)."""
        return True

    def forward(self, state: QueryState) -> GaussianAttributes:
        """(B, N, D) -> attributes of (B, N, K) Gaussians."""
        raw_BNC = self.linear(self.norm(state.features))
        # All K Gaussians of a query come from one linear layer, channel by channel.
        return self.activate(rearrange(raw_BNC, "b n (k c) -> b n k c", c=sum(CHANNELS)))

    def activate(self, raw_BNKC: Tensor) -> GaussianAttributes:
        """Raw channels (B, N, K, 14) to attributes, in float32 or better."""
        offsets, opacity, scale, rotation, sh = at_least_float32(raw_BNKC).split(CHANNELS, -1)
        return GaussianAttributes(
            offsets=offsets,
            scales=self.config.scale_unit * F.softplus(scale),
            quats=F.normalize(rotation, dim=-1, eps=self.config.quat_eps),
            opacities=torch.sigmoid(opacity[..., 0]),
            # The release renders a harmonic of degree 0 and clips what it shows.
            colors=(0.5 + SH_C0 * sh).clamp(0, 1),
        )

"""`gslrm/pixel_head`: LayerNorm and one linear layer, a token to the Gaussians of its pixels."""

from typing import Literal

import torch
from einops import rearrange
from pydantic import Field
from torch import Tensor, nn

from qgs.components import NORM_EPS
from qgs.contracts import ComponentConfig, Head, ModelDims
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.precision import at_least_float32
from qgs.types import GaussianAttributes, QueryState


class PixelHead(Head):
    """LayerNorm, then D -> K (3 or 1 + 11) linear, both without biases."""

    name = "pixel_head"

    class Config(ComponentConfig):
        """Defaults are those of the public re-implementations."""

        gaussians_per_query: int = Field(default=64, ge=1)
        """K, the Gaussians of each token: one per pixel where it is the square of the encoder's
        `patch_size`, fewer or more on an even grid otherwise."""
        position_channels: Literal[1, 3] = 3
        """Raw numbers that place a Gaussian on its ray; of three the mean counts (paper: 1).
        With 1, centres other than `gslrm/along_rays` get three equal offsets."""
        scale_bias: float = -2.3
        """Added to the logarithm of scales, world units."""
        scale_limit: float | None = -1.2
        """Largest logarithm of a scale, world units; null for none."""
        opacity_bias: float = -2.0
        """Added to the opacity logit."""
        init_std: float = Field(default=0.02, gt=0)
        """Standard deviation of the normal distribution that the weights start from."""
        norm_eps: float = Field(default=NORM_EPS, gt=0)
        """Added to the variance by the LayerNorm."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.channels = (config.position_channels, 3, 3, 4, 1)
        self.norm = nn.LayerNorm(dims.width, config.norm_eps, bias=False)
        outputs = config.gaussians_per_query * sum(self.channels)
        self.linear = nn.Linear(dims.width, outputs, bias=False)
        nn.init.normal_(self.linear.weight, std=config.init_std)

    def decays(self, name: str, parameter: nn.Parameter) -> bool:
        """Weight decay on the linear layer too (paper); a head has none by default."""
        return parameter.ndim != 1

    def forward(self, state: QueryState) -> GaussianAttributes:
        """(B, N, D) -> attributes of (B, N, K) Gaussians, float32 or better."""
        raw_BNC = at_least_float32(self.linear(self.norm(state.features)))
        raw_BNKC = rearrange(raw_BNC, "b n (k c) -> b n k c", c=sum(self.channels))
        position, rgb, scale, rotation, opacity = raw_BNKC.split(self.channels, -1)
        scale = scale + self.config.scale_bias
        if self.config.scale_limit is not None:
            scale = scale.clamp_max(self.config.scale_limit)
        return GaussianAttributes(
            offsets=position.expand(*position.shape[:-1], 3),
            scales=scale.exp(),
            quats=_unit(rotation),
            opacities=torch.sigmoid(opacity[..., 0] + self.config.opacity_bias),
            colors=(0.5 + SH_C0 * rgb).clamp(0, 1),
        )


def _unit(quats: Tensor) -> Tensor:
    """Quaternions (..., 4) of length 1; the identity for those of length 0."""
    length = quats.norm(dim=-1, keepdim=True)
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    return torch.where(length > 0, quats / torch.where(length > 0, length, 1), identity)

"""Head `qgs/gaussian_head` (TokenGS, LocusGS), and means of Gaussians: `qgs/free`, `qgs/offset`."""

import math
from abc import abstractmethod
from collections.abc import Iterable

import torch
import torch.nn.functional as F
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor, nn

from qgs.contracts import (
    Centers,
    ComponentConfig,
    Head,
    ModelDims,
    Problem,
    RecipeContext,
    without_effect,
)
from qgs.geometry.constants import constant
from qgs.precision import at_least_float32, full_precision
from qgs.tokengs.blocks import NormConfig
from qgs.types import GaussianAttributes, QueryState

CHANNELS = (3, 3, 3, 4, 1)
"""Channels per Gaussian: position, RGB, scale, rotation, opacity (TokenGS, LocusGS releases)."""


class LinearHead(Head):
    """Base of heads in which a norm and a linear layer give C numbers for each Gaussian."""

    norm: nn.Module
    linear: nn.Linear

    def forward(self, state: QueryState) -> GaussianAttributes:
        raw_BNC = self.linear(self.norm(state.features))
        # One linear layer gives all K Gaussians of a query, Gaussian by Gaussian.
        return self.activate(raw_BNC.unflatten(-1, (self.gaussians_per_query, -1)))

    @abstractmethod
    def activate(self, raw_BNKC: Tensor) -> GaussianAttributes:
        """Convert raw channels (B, N, K, C) to attributes of Gaussians, in float32 or better."""


class GaussianHead(LinearHead):
    """Linear head: a query's D features give 14 numbers for each of its K Gaussians.

    The activations of TokenGS and LocusGS follow, in float32.
    """

    name = "gaussian_head"

    class Config(NormConfig):
        """Options; the defaults are those of the LocusGS release."""

        gaussians_per_query: PositiveInt = 64
        """Number K of Gaussians per query."""
        init_std: PositiveFloat = 0.002
        """Standard deviation of the initial weights (truncated normal)."""
        position_std: PositiveFloat | None = None
        """Standard deviation of the initial weights for positions; null means `init_std`."""
        z_init: float = 0.0
        """Initial bias of the raw z of positions (default 0; TokenGS release 2026.6: log 1.1)."""
        norm: bool = False
        """Use a LayerNorm before the linear layer. TokenGS and LocusGS have none; a LayerNorm helps
        small models."""
        scale_cap: PositiveFloat = 0.075
        """Largest scale in world units. A raw scale of 0 gives 1/e of this limit."""
        scale_input_limit: PositiveFloat | None = 10.0
        """Limit of the absolute value of raw scales before the exponential. null means no limit, as
        in TokenGS."""
        opacity_bias: float = -2.0
        """Number added to the raw opacity before the sigmoid."""
        quat_eps: PositiveFloat = 1e-4
        """Smallest divisor when raw quaternions are normalised (TokenGS: 1e-12)."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.norm = nn.LayerNorm(dims.width, config.norm_eps) if config.norm else nn.Identity()
        self.linear = nn.Linear(dims.width, config.gaussians_per_query * sum(CHANNELS))
        # Small weights: all Gaussians of a query start at one place, near one size and grey.
        nn.init.zeros_(self.linear.bias)
        nn.init.trunc_normal_(self.linear.weight, std=config.init_std)
        spread_positions(self.linear, config.gaussians_per_query, config.position_std)
        with torch.no_grad():
            self.linear.bias.unflatten(0, (-1, sum(CHANNELS)))[:, CHANNELS[0] - 1] = config.z_init

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        if not config.norm:
            yield from without_effect(config, ("norm_eps",), "`norm` is false")

    def activate(self, raw_BNKC: Tensor) -> GaussianAttributes:
        offsets, rgb, scale, rotation, opacity = at_least_float32(raw_BNKC).split(CHANNELS, -1)
        cap = self.config.scale_cap
        limit = self.config.scale_input_limit
        # Exp of a stray output would be infinite, its gradient NaN.
        if limit is not None:
            scale = scale.clamp(-limit, limit)
        return GaussianAttributes(
            offsets=offsets,
            # cap / e at 0, never above the cap (TokenGS release): one huge Gaussian hides a scene
            scales=torch.exp(scale - (1 - math.log(cap))).clamp_max(cap),
            # eps: a raw quaternion near 0 would turn by any amount in a step
            quats=F.normalize(rotation, dim=-1, eps=self.config.quat_eps),
            opacities=torch.sigmoid(opacity[..., 0] + self.config.opacity_bias),
            colors=(torch.tanh(rgb) + 1) / 2,
        )


@torch.no_grad()
def spread_positions(linear: nn.Linear, count: int, std: float | None) -> None:
    """Draw the rows of a head's initial weights that give positions; None leaves them as they are.

    count: number of Gaussians of a query; each has as many rows, the first three for its position.
    std: standard deviation (truncated normal).
    """
    # Spread initial positions divide the scene sooner.
    if std is not None:
        rows_K3D = torch.empty(count, 3, linear.in_features)
        nn.init.trunc_normal_(rows_K3D, std=std)
        linear.weight.unflatten(0, (count, -1))[:, :3] = rows_K3D


@full_precision
def posact(
    t: Tensor, input_limit: float | None = None, output_limit: float | None = None
) -> Tensor:
    """Compute sign(t) (exp|t| - 1), linear near 0 and exponential far out (TokenGS release).

    input_limit: largest |t|, to which t is clamped; None means no limit.
    output_limit: largest absolute result; None means no limit.
    The LocusGS release uses limits 100 and 1000, the TokenGS release none. The slope is 1 at t = 0,
    so that a head that starts at zero can learn; it is 0 beyond a limit.
    """
    # Exp of a stray output would be infinite.
    if input_limit is not None:
        t = t.clamp(-input_limit, input_limit)
    if output_limit is not None:
        # An exponential that overflows has slope 0 * inf.
        end = math.log1p(output_limit) + 1
        t = t.clamp(-end, end)
    # expm1, not exp - 1, which has no digits left where t is near 0.
    result = torch.where(t >= 0, torch.expm1(t), -torch.expm1(-t))
    return result if output_limit is None else result.clamp(-output_limit, output_limit)


class FreeCenters(Centers):
    """Free centers: mean = posact(offset) + (0, 0, z_offset).

    `offset` is an output of the head. posact(t) is sign(t) (exp|t| - 1).
    """

    name = "free"

    class Config(ComponentConfig):
        z_offset: float = 1.0
        """Number added to z, in world units (1 in TokenGS, 0 in LocusGS's free-centre ablation)."""
        input_limit: PositiveFloat | None = 100.0
        """Limit of the absolute value of raw offsets. null means no limit. LocusGS has 100, TokenGS
        null."""
        output_limit: PositiveFloat | None = 1000.0
        """Limit of the absolute value of posact(offset), in world units. null means no limit.
        LocusGS has 1000, TokenGS null."""

    config: Config

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        # A head that starts near zero puts all Gaussians at z_offset, in front of the first camera.
        means = posact(offsets, self.config.input_limit, self.config.output_limit)
        return _further(means, self.config.z_offset)


class OffsetCenters(Centers):
    """Offset centers: mean = offset + (0, 0, z_offset)."""

    name = "offset"

    class Config(ComponentConfig):
        z_offset: float = 1.0
        """Number added to z, in world units (1 in C3G, 1.5 in GlobalSplat)."""

    config: Config

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        return _further(at_least_float32(offsets), self.config.z_offset)


def _further(means: Tensor, z: float) -> Tensor:
    return means + constant([0.0, 0.0, z], means)

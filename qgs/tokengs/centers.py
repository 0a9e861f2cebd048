"""`qgs/free` (TokenGS), `qgs/offset`: means from the head's offsets, anywhere in the world."""

import math

import torch
from pydantic import Field
from torch import Tensor

from qgs.contracts import Centers, ComponentConfig
from qgs.geometry.constants import constant
from qgs.geometry.precision import at_least_float32, full_precision
from qgs.types import QueryState


@full_precision
def posact(
    t: Tensor, input_limit: float | None = None, output_limit: float | None = None
) -> Tensor:
    """sign(t) (exp|t| - 1): linear near 0, exponential far out (TokenGS release).

    input_limit: |t| is clamped to it. output_limit: the size of the result is (LocusGS release: 100
    and 1000; TokenGS: none). The slope is 1 at 0, so that a head which starts at zero can learn,
    and 0 outside a limit.
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
    """mean = posact(offset) + (0, 0, z_offset)."""

    name = "free"

    class Config(ComponentConfig):
        z_offset: float = 1.0
        """Added to z, world units (1 in TokenGS, 0 in LocusGS's free-centre ablation)."""
        input_limit: float | None = Field(default=100.0, gt=0)
        """Raw offsets are clamped to +- this; null for no clamp (LocusGS 100, TokenGS null)."""
        output_limit: float | None = Field(default=1000.0, gt=0)
        """Offsets are clamped to +- this, world units; null for no clamp (LocusGS 1000)."""

    config: Config

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        # A head that starts near zero puts all Gaussians at z_offset, in front of the first camera.
        means = posact(offsets, self.config.input_limit, self.config.output_limit)
        return _further(means, self.config.z_offset)


class OffsetCenters(Centers):
    """mean = offset + (0, 0, z_offset)."""

    name = "offset"

    class Config(ComponentConfig):
        z_offset: float = 1.0
        """Added to z, world units (1 in C3G, 1.5 in GlobalSplat)."""

    config: Config

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        return _further(at_least_float32(offsets), self.config.z_offset)


def _further(means: Tensor, z: float) -> Tensor:
    return means + constant([0.0, 0.0, z], means)

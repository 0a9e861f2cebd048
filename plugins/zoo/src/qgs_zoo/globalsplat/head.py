"""`globalsplat/merging_head`: head that decodes candidates and merges them into Gaussians.

Axes: B scenes, N tokens, C candidates of a token, G Gaussians of a token.
"""

import math
from collections.abc import Iterable

import torch
import torch.nn.functional as F
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor, nn

from qgs.containers import concatenated
from qgs.contracts import (
    GAUSSIAN_FIELDS,
    ComponentConfig,
    Fields,
    Head,
    ModelDims,
    Problem,
    RecipeContext,
)
from qgs.geometry.constants import constant
from qgs.geometry.harmonics import SH_C0
from qgs.precision import full_precision
from qgs.tokengs.head import spread_positions
from qgs.types import GaussianAttributes, QueryState
from qgs_zoo.globalsplat.streams import TEXTURE, TEXTURE_FIELD
from qgs_zoo.parts import quaternions

CHANNELS = (3, 3, 6, 1)
"""Channels of geometry per candidate: position, log scale, rotation, opacity; then one gate."""


class MergingHead(Head):
    """Head that decodes each token into candidates and merges blocks of them into Gaussians.

    The geometry of a token gives position, log scale, 6D rotation, opacity and gate of each
    candidate. Its texture gives coefficients of spherical harmonics. The candidates of a token form
    2^level blocks of equal size. A merged Gaussian is the mean of its block, weighted by the
    softmax of the gates. The mean is over positions, rotations, coefficients, log scales and
    log(1 - opacity). Then log(size of the block) / 3 is added to log scales. At a fractional level,
    the Gaussians of both adjacent whole levels are rendered. Their log(1 - opacity) is multiplied
    by a blend weight: level - floor(level) for the upper level, and 1 minus this for the lower one.
    """

    name = "merging_head"
    reads = TEXTURE_FIELD
    scheduled = frozenset({"level"})

    class Config(ComponentConfig):
        candidates: PositiveInt = 16
        """Number of candidate Gaussians of each token, a power of two."""
        level: NonNegativeFloat = 3.0
        """Base-2 logarithm of the number of Gaussians per token. At a fractional level, the
        Gaussians of both adjacent whole levels are rendered and blended."""
        sh_degree: int = Field(default=3, ge=0, le=3)
        """Degree of the spherical harmonics. 0 means colours that do not depend on the viewing
        direction."""
        init_std: PositiveFloat = 0.02
        """Standard deviation of the initial weights, which have a truncated normal distribution."""
        position_std: PositiveFloat | None = None
        """Standard deviation of the initial weights that give positions. Null means `init_std`."""
        scale_bias: float = -2.0
        """Number added to raw log scales before they are bounded."""
        scale_min: PositiveFloat = 1e-4
        """Sets the smallest scale of a candidate Gaussian in world units, which is `scale_min` / e
        with e = 2.718."""
        scale_max: PositiveFloat = 0.05
        """Sets the largest scale of a candidate Gaussian in world units, which is `scale_max` times
        e^2 = 7.389."""
        opacity_bias: float = -5.0
        """Number added to the logits of opacities."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.coefficients = (config.sh_degree + 1) ** 2
        self.geometry_norm = nn.LayerNorm(dims.width)
        self.geometry = nn.Linear(dims.width, config.candidates * (sum(CHANNELS) + 1))
        self.texture_norm = nn.LayerNorm(dims.width)
        self.texture = nn.Linear(dims.width, config.candidates * self.coefficients * 3)
        # Small weights: at first all candidates of a token are nearly one Gaussian.
        for linear in (self.geometry, self.texture):
            nn.init.zeros_(linear.bias)
            nn.init.trunc_normal_(linear.weight, std=config.init_std)
        # Positions may start with a wider spread than scales and opacities.
        spread_positions(self.geometry, config.candidates, config.position_std)

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        most = round(math.log2(config.candidates))
        if 2**most != config.candidates:
            reason = f"must be a power of two, got {config.candidates}"
            yield Problem("candidates", reason, f"write {2**most}")
        if config.level > most:
            reason = f"{config.candidates} candidates cannot form 2^{config.level:g} Gaussians"
            yield Problem("level", reason, f"write at most {most}, or raise `candidates`")
        if config.scale_min >= config.scale_max:
            reason = f"must be below `scale_max`, which is {config.scale_max:g}"
            yield Problem("scale_min", reason, f"write a number below {config.scale_max:g}")

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        """Return the field for spherical harmonics' coefficients; no field if `sh_degree` is 0."""
        sh = "gaussians.sh"
        return {sh: GAUSSIAN_FIELDS[sh]} if config.sh_degree else {}

    @property
    def gaussians_per_query(self) -> int:
        """Number of Gaussians per token.

        It is 2^level for a whole level. For a fractional level, it is the sum of the numbers for
        both adjacent whole levels.
        """
        return sum(count for count, _ in stages(self.config.level))

    def forward(self, state: QueryState) -> GaussianAttributes:
        """Return attributes of the Gaussians merged from the candidates of all tokens."""
        each = (self.config.candidates, -1)
        geometry = self.geometry(self.geometry_norm(state.features)).unflatten(-1, each)
        texture = self.texture(self.texture_norm(state[TEXTURE])).unflatten(-1, each)
        return self.activate(geometry, texture)

    @full_precision
    def activate(self, geometry: Tensor, texture: Tensor) -> GaussianAttributes:
        """Merge candidates from raw channels, and return attributes in float32 or float64.

        geometry, texture: raw channels of candidates, (B, N, C, 14) and (B, N, C, 3 (degree +
        1)^2).
        """
        place, log_scale, rotation, opacity, gates = geometry.split((*CHANNELS, 1), -1)
        config = self.config
        low = math.log(config.scale_min) - 1
        high = math.log(config.scale_max) + 2
        log_scale = (log_scale + config.scale_bias).clamp(low, high)
        # Zeros are not a rotation; with this, every candidate starts at the identity.
        rotation = rotation + constant([1, 0, 0, 0, 1, 0], rotation)
        # Where Gaussians overlap, logs of transmittance add up, but opacities do not.
        clear = -F.softplus(opacity + config.opacity_bias)
        candidates = torch.cat([place, log_scale, rotation, clear, texture], -1)
        # Both levels of a blend are decoded from the same candidates.
        parts = [
            self._attributes(merged(candidates, gates[..., 0], count), share)
            for count, share in stages(config.level)
        ]
        return concatenated(parts, 2)

    def _attributes(self, x_BNKX: Tensor, share: float) -> GaussianAttributes:
        """Return the attributes of Gaussians from the averaged channels of their candidates.

        share: blend weight of the Gaussians' level.
        """
        offsets, log_scale, rotation, clear, texture = x_BNKX.split(
            (*CHANNELS, 3 * self.coefficients), -1
        )
        # Larger Gaussians keep the total volume.
        growth = math.log(self.config.candidates / x_BNKX.shape[2]) / 3
        sh_BNKC3 = texture.unflatten(-1, (self.coefficients, 3))
        return GaussianAttributes(
            offsets=offsets,
            scales=(log_scale + growth).exp(),
            quats=rotation_6d(rotation),
            opacities=-torch.expm1(share * clear[..., 0]),
            colors=0.5 + SH_C0 * sh_BNKC3[..., 0, :],
            sh=sh_BNKC3[..., 1:, :] if self.config.sh_degree else None,
        )


LEAST_LENGTH = 1e-4
"""Least length by which a vector is divided when it is normalised."""


@full_precision
def merged(candidates: Tensor, gates: Tensor, count: int) -> Tensor:
    """Average C candidates in `count` equal blocks, weighted by the softmax of each block's gates.

    candidates: (..., C, X), with X channels each. gates: (..., C). Returns the averages of the
    blocks, (..., count, X).
    """
    # Gates compete only within their block, so that blocks stay independent.
    weights = gates.unflatten(-1, (count, -1)).softmax(-1)
    return (weights[..., None] * candidates.unflatten(-2, (count, -1))).sum(-2)


def stages(level: float) -> list[tuple[int, float]]:
    """Return the numbers of Gaussians per token that are rendered at a level, with blend weights.

    A whole level s gives one number, 2^s, with weight 1. A fractional level gives the numbers for
    both adjacent whole levels, with weights that add up to 1. The head multiplies log(1 - opacity)
    of the Gaussians by these weights.
    """
    low = math.floor(level)
    share = level - low
    return [(2**low, 1 - share), (2 ** (low + 1), share)] if share else [(2**low, 1.0)]


@full_precision
def rotation_6d(vectors: Tensor) -> Tensor:
    """Return unit quaternions (..., 4), w x y z, of rotations given by their first two columns.

    vectors: two columns (..., 6). The first is normalised, then the second is made orthonormal to
    it (Zhou et al. 2019). If the columns are zero or parallel, they define no rotation, but the
    quaternion still has unit length.
    """
    first, second = vectors.split(3, -1)
    first = F.normalize(first, dim=-1, eps=LEAST_LENGTH)
    # Gram-Schmidt: the first column keeps its direction.
    second = second - (first * second).sum(-1, keepdim=True) * first
    second = F.normalize(second, dim=-1, eps=LEAST_LENGTH)
    third = torch.linalg.cross(first, second)
    return quaternions(torch.stack([first, second, third], -1))

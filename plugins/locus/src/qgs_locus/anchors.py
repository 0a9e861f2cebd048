"""`locus/anchored`: queries with a 3D anchor, which is a centre with a support radius."""

from abc import abstractmethod
from collections.abc import Iterable
from typing import Annotated, Literal

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat
from torch import Tensor, nn

from qgs.contracts import (
    Ascending,
    ComponentConfig,
    Fields,
    ModelDims,
    Problem,
    RecipeContext,
    without_effect,
)
from qgs.tokengs import LatentQueries
from qgs.types import QueryState, SpatialSupport
from qgs_locus.fields import (
    CENTER,
    CENTER_FIELD,
    RAW_RADIUS,
    RadiusOptions,
    ball_support,
    radius_field,
    raw_radius_of,
    support_radius,
)


class NormalCenters(ComponentConfig):
    """Normal distribution of the initial anchor centres; the defaults are LocusGS's."""

    kind: Literal["normal"] = "normal"
    """Draw the initial anchor centres from a normal distribution around `mean`."""
    mean: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Mean of the centres, world units."""
    std: NonNegativeFloat = 1.0
    """Standard deviation of each coordinate, world units."""

    def sample(self, count: int) -> Tensor:
        """Return `count` random anchor centres (count, 3), world frame."""
        return torch.randn(count, 3) * self.std + torch.tensor(self.mean)


class FrustumCenters(ComponentConfig):
    """Random anchor centres in the first camera's frustum, uniform over its image and log depth."""

    kind: Literal["frustum"]
    """Draw the initial anchor centres in the frustum of the first camera. They are uniformly
    distributed over the image and over the logarithm of depth."""
    depth: Ascending = (0.3, 3.0)
    """[nearest, farthest] depth z of a centre, world units."""
    slope: PositiveFloat = 0.6
    """Largest |x / z| and |y / z| of a centre. This is half of the frustum's width and height at
    depth 1."""

    def sample(self, count: int) -> Tensor:
        """Return `count` random anchor centres (count, 3), world frame."""
        near, far = self.depth
        # Equal steps of parallax, not of depth.
        z = near * (far / near) ** torch.rand(count, 1)
        return torch.cat([(2 * torch.rand(count, 2) - 1) * self.slope * z, z], -1)


class CentredQueries(LatentQueries):
    """Base of N learned queries with features and anchor centres, the same in every scene."""

    class Config(RadiusOptions, LatentQueries.Config):
        center_init: Annotated[NormalCenters | FrustumCenters, Field(discriminator="kind")] = (
            NormalCenters()
        )
        """Distribution of the initial anchor centres."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        # Centres are learned, as features are: every scene starts with the same anchors.
        self.center = nn.Parameter(config.center_init.sample(config.count))

    def start(self, batch_size: int) -> QueryState:
        """Return initial queries: features (B, N, D), and the fields of their anchors."""
        own = {CENTER: self.center, **self.shapes()}
        fields = {name: x.expand(batch_size, -1, -1) for name, x in own.items()}
        return super().start(batch_size).replace(fields=fields)

    @abstractmethod
    def shapes(self) -> dict[str, Tensor]:
        """Return the fields of anchors besides their centres, as (N, ...) by name."""


class AnchoredQueries(CentredQueries):
    """N learned queries: features, anchor centres mu and raw radii rho (before softplus).

    Every scene starts with the same N queries.
    """

    name = "anchored"

    class Config(CentredQueries.Config):
        radius: bool = True
        """Give anchors a support radius. With false, they have a centre only."""
        init_radius: PositiveFloat = 1.0
        """Initial radius of each anchor, world units. `radius_bound` tells whether `radius_min` is
        its lower bound or is added to it."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        if config.radius:
            # Stored before softplus, so that no optimiser step can make a radius negative.
            raw = raw_radius_of(config.init_radius)
            self.raw_radius = nn.Parameter(torch.full((config.count, 1), raw))

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        return {**CENTER_FIELD, **(radius_field(config) if config.radius else {})}

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Report radius options that have no effect because `radius` is false."""
        if not config.radius:
            idle = ("init_radius", "radius_bound", "radius_min")
            yield from without_effect(config, idle, "`radius` is false")

    def shapes(self) -> dict[str, Tensor]:
        """Return the raw radii (N, 1), or nothing if anchors have no radius."""
        return {RAW_RADIUS: self.raw_radius} if self.config.radius else {}

    def support(self, state: QueryState) -> SpatialSupport:
        """Return each anchor as a ball of its support radius, or as a point if it has no radius."""
        center_BN3 = state[CENTER]
        # A radius of 0 shows an anchor as a point.
        r_BN1 = torch.zeros_like(center_BN3[..., :1])
        if self.config.radius:
            r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        return ball_support(center_BN3, r_BN1)

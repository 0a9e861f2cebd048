"""`locus/anchor_offset`, `locus/radius_scaled`: Gaussian means around the query's anchor."""

from collections.abc import Iterable
from typing import Literal

from pydantic import Field
from torch import Tensor

from qgs.contracts import Centers, ComponentConfig, Fields, Problem, RecipeContext, without_effect
from qgs.precision import at_least_float32
from qgs.tokengs import posact
from qgs.types import QueryState
from qgs_locus.fields import (
    CENTER,
    CENTER_FIELD,
    RAW_RADIUS,
    RadiusOptions,
    radius_field,
    support_radius,
)


class OffsetOptions(ComponentConfig):
    """Options that turn raw offsets into displacements from the anchor."""

    offset: Literal["posact", "linear"] = "posact"
    """Displacement for a raw offset t: posact(t) (release), or t itself (paper)."""
    input_limit: float | None = Field(default=100.0, gt=0)
    """Clamp raw offsets to +- this before posact. Null means no clamp."""
    output_limit: float | None = Field(default=1000.0, gt=0)
    """Clamp displacements to +- this after posact. Null means no clamp."""

    def displacement(self, raw: Tensor) -> Tensor:
        """Return the displacements for raw offsets of any shape, in float32 or better."""
        if self.offset == "linear":
            return at_least_float32(raw)
        # An untrained head may give huge offsets; the limits keep them and their gradients finite.
        return posact(raw, self.input_limit, self.output_limit)


class AnchorOffsetCenters(Centers):
    """Means at mu + posact(offset), with mu the anchor's centre."""

    name = "anchor_offset"
    reads = CENTER_FIELD

    class Config(OffsetOptions):
        """Options of `OffsetOptions`."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Report limits that have no effect because posact is not used."""
        if config.offset == "linear":
            yield from without_effect(config, ("input_limit", "output_limit"), "`offset` is linear")

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """Return means (B, N, K, 3) for raw offsets (B, N, K, 3)."""
        return state[CENTER][:, :, None] + self.config.displacement(offsets)


class RadiusScaledCenters(AnchorOffsetCenters):
    """Means at mu + r posact(offset), with r the support radius: equation (7)."""

    name = "radius_scaled"

    class Config(OffsetOptions, RadiusOptions):
        """Options of `OffsetOptions` and `RadiusOptions`."""

    config: Config

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        """Return centres and radii."""
        return {**CENTER_FIELD, **radius_field(config)}

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """Return means (B, N, K, 3) for raw offsets (B, N, K, 3)."""
        # Offsets are in radii: a query with a large support spreads its Gaussians widely.
        r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        return state[CENTER][:, :, None] + r_BN1[:, :, None] * self.config.displacement(offsets)

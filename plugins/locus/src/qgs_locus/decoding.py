"""`locus/anchor_offset`, `locus/radius_scaled`: means around the query's anchor."""

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
    """How raw offsets become displacements from the anchor."""

    offset: Literal["posact", "linear"] = "posact"
    """Displacement of a raw offset t: posact(t) (release) or t itself (paper)."""
    input_limit: float | None = Field(default=100.0, gt=0)
    """Raw offsets are clamped to +- this before posact; null for no clamp."""
    output_limit: float | None = Field(default=1000.0, gt=0)
    """Displacements are clamped to +- this after posact; null for no clamp."""

    def displacement(self, raw: Tensor) -> Tensor:
        """Displacements of raw offsets, float32 or better, any shape."""
        if self.offset == "linear":
            return at_least_float32(raw)
        # The limits keep stray offsets of an untrained head finite, and their gradients.
        return posact(raw, self.input_limit, self.output_limit)


class AnchorOffsetCenters(Centers):
    """mean = mu + posact(offset)."""

    name = "anchor_offset"
    reads = CENTER_FIELD

    class Config(OffsetOptions):
        """See `OffsetOptions`."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Limits of a posact that is not used."""
        if config.offset == "linear":
            yield from without_effect(config, ("input_limit", "output_limit"), "`offset` is linear")

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """(B, N, K, 3) -> (B, N, K, 3)."""
        return state[CENTER][:, :, None] + self.config.displacement(offsets)


class RadiusScaledCenters(AnchorOffsetCenters):
    """mean = mu + r posact(offset), equation (7)."""

    name = "radius_scaled"

    class Config(OffsetOptions, RadiusOptions):
        """See `OffsetOptions` and `RadiusOptions`."""

    config: Config

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        """Centres and radii."""
        return {**CENTER_FIELD, **radius_field(config)}

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """(B, N, K, 3) -> (B, N, K, 3)."""
        # Offsets count in radii: a query of a large support spreads its Gaussians as far.
        r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        return state[CENTER][:, :, None] + r_BN1[:, :, None] * self.config.displacement(offsets)

"""`locus/anchor_offset`, `locus/radius_scaled`: Gaussian means around the query's anchor."""

from collections.abc import Iterable
from typing import Literal

from pydantic import PositiveFloat
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
    """Options of the map from the head's raw offsets to displacements from the anchor."""

    offset: Literal["posact", "linear"] = "posact"
    """Displacement for a raw offset t: posact(t) = sign(t) (exp|t| - 1) (LocusGS release), or t
    itself ("linear", LocusGS paper)."""
    input_limit: PositiveFloat | None = 100.0
    """Limit of raw offsets, from -input_limit to input_limit, with `offset: posact`. Null: none."""
    output_limit: PositiveFloat | None = 1000.0
    """Limit of displacements, from -output_limit to output_limit, with `offset: posact`. Null means
    no limit."""

    def displacement(self, raw: Tensor) -> Tensor:
        """Return displacements for raw offsets of any shape, in float32 or float64."""
        if self.offset == "linear":
            return at_least_float32(raw)
        # An untrained head may give huge offsets; the limits keep them and their gradients finite.
        return posact(raw, self.input_limit, self.output_limit)


class AnchorOffsetCenters(Centers):
    """Gaussian means at mu + posact(offset), with mu the anchor's centre.

    `offset` is an output of the head. posact(t) is sign(t) (exp|t| - 1).
    """

    name = "anchor_offset"
    reads = CENTER_FIELD

    class Config(OffsetOptions):
        """Options of the map from raw offsets to displacements."""

    config: Config

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Report `input_limit` and `output_limit`, which have no effect if `offset` is linear."""
        if config.offset == "linear":
            yield from without_effect(config, ("input_limit", "output_limit"), "`offset` is linear")

    def forward(self, offsets: Tensor, state: QueryState) -> Tensor:
        """Return world-frame means (B, N, K, 3) for the head's raw offsets (B, N, K, 3)."""
        steps = self.steps(self.config.displacement(offsets), state)
        return state[CENTER][:, :, None] + steps

    def steps(self, displaced: Tensor, state: QueryState) -> Tensor:
        """Return steps (B, N, K, 3) from the anchor's centre, world frame.

        displaced: displacements (B, N, K, 3), in the unit and along the axes of the component.
        """
        return displaced


class RadiusScaledCenters(AnchorOffsetCenters):
    """Gaussian means at mu + r posact(offset), with centre mu and radius r of the anchor.

    `offset` is an output of the head. posact(t) is sign(t) (exp|t| - 1). This is equation (7) of
    the plugin's README.
    """

    name = "radius_scaled"

    class Config(OffsetOptions, RadiusOptions):
        """Options of the maps from raw offsets to displacements and from raw radii to radii."""

    config: Config

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        return {**CENTER_FIELD, **radius_field(config)}

    def steps(self, displaced: Tensor, state: QueryState) -> Tensor:
        """Return steps from the anchor's centre, for displacements in radii of the anchor."""
        # A query with a large support spreads its Gaussians widely.
        r_BN1 = support_radius(state[RAW_RADIUS], self.config)
        return r_BN1[:, :, None] * displaced

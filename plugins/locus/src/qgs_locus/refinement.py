"""`locus/refine`: anchors move and their radii change after every layer."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field
from torch import Tensor, nn

from qgs.components import Mlp, posact
from qgs.contracts import Fields, ModelDims, Refinement
from qgs.geometry.precision import at_least_float32
from qgs.types import QueryState
from qgs_locus.fields import CENTER, CENTER_FIELD, RAW_RADIUS, RadiusOptions, radius_field


class AnchorRefinement(Refinement):
    """mu += posact(MLP_mu(x)), rho += MLP_rho(x), heads shared by all layers (LocusGS)."""

    name: ClassVar[str] = "refine"

    class Config(RadiusOptions):
        """center, radius: which of the two is refined.

        center_step: the step is posact(f(x)) (release) or f(x) (paper). input_limit, output_limit:
        clamps of posact. zero_init: the last layer of each head starts at zero (in neither release;
        steadier in short trainings), else as PyTorch initialises it.
        """

        center: bool = True
        radius: bool = True
        center_step: Literal["posact", "linear"] = "posact"
        input_limit: float | None = Field(default=100.0, gt=0)
        output_limit: float | None = Field(default=1000.0, gt=0)
        zero_init: bool = False

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        if config.center:
            self.center_mlp = self._head(3)
        if config.radius:
            self.radius_mlp = self._head(1)

    def _head(self, channels: int) -> Mlp:
        mlp = Mlp(self.dims.width, self.dims.width, channels)
        if self.config.zero_init:
            nn.init.zeros_(mlp.fc2.weight)
            nn.init.zeros_(mlp.fc2.bias)
        return mlp

    @classmethod
    def requires(cls, config: Config) -> Fields:
        """Whatever is refined."""
        center = CENTER_FIELD if config.center else {}
        return {**center, **(radius_field(config) if config.radius else {})}

    @classmethod
    def provides(cls, config: Config) -> Fields:
        """Whatever is refined."""
        return cls.requires(config)

    def forward(self, state: QueryState) -> QueryState:
        """A state with moved centres and changed raw radii."""
        refined: dict[str, Tensor] = {}
        if self.config.center:
            refined[CENTER] = state[CENTER] + self._center_step(state.features)
        if self.config.radius:
            step = at_least_float32(self.radius_mlp(state.features))
            refined[RAW_RADIUS] = state[RAW_RADIUS] + step
        return state.replace(fields=refined)

    def _center_step(self, features: Tensor) -> Tensor:
        step = self.center_mlp(features)
        if self.config.center_step == "linear":
            return at_least_float32(step)
        return posact(step, self.config.input_limit, self.config.output_limit)

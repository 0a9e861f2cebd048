"""`ellipsoid/refine`: anchors move, turn and change their radii after every layer."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Literal

from pydantic import Field
from qgs_locus.fields import CENTER, CENTER_FIELD, RadiusOptions
from torch import Tensor, nn

from qgs.components import Mlp, posact
from qgs.contracts import Fields, ModelDims, Problem, RecipeContext, Refinement, without_effect
from qgs.geometry.precision import at_least_float32
from qgs.types import QueryState
from qgs_ellipsoid.fields import RAW_RADII, ROTATION, ROTATION_FIELD, radii_field
from qgs_ellipsoid.rotations import turned


class EllipsoidRefinement(Refinement):
    """mu += posact(MLP(x)), R = turn(MLP(x)) R, rho += MLP(x), heads shared by all layers."""

    name: ClassVar[str] = "refine"

    class Config(RadiusOptions):
        center: bool = True
        """Whether centres are refined."""
        rotation: bool = True
        """Whether rotations are refined."""
        radius: bool = True
        """Whether the three radii are refined."""
        center_step: Literal["posact", "linear"] = "posact"
        """The step of a centre for an MLP output t: posact(t) (release) or t itself (paper)."""
        input_limit: float | None = Field(default=100.0, gt=0)
        """MLP outputs are clamped to +- this before posact; null for no clamp."""
        output_limit: float | None = Field(default=1000.0, gt=0)
        """Steps are clamped to +- this after posact, world units; null for no clamp."""
        zero_init: bool = False
        """The last layer of each MLP starts at zero (in neither release; steadier at first)."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        if config.center:
            self.center_mlp = self._head()
        if config.radius:
            self.radius_mlp = self._head()
        if config.rotation:
            self.rotation_mlp = self._head()

    def _head(self) -> Mlp:
        head = Mlp(self.dims.width, self.dims.width, 3)
        if self.config.zero_init:
            nn.init.zeros_(head.fc2.weight)
            nn.init.zeros_(head.fc2.bias)
        return head

    @classmethod
    def requires(cls, config: Config) -> Fields:
        """Whatever is refined."""
        parts = {"center": CENTER_FIELD, "rotation": ROTATION_FIELD, "radius": radii_field(config)}
        chosen = [fields for part, fields in parts.items() if getattr(config, part)]
        return {name: spec for fields in chosen for name, spec in fields.items()}

    @classmethod
    def provides(cls, config: Config) -> Fields:
        """Whatever is refined."""
        return cls.requires(config)

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Something must be refined, and every option must matter."""
        if not cls.requires(config):
            reason = "`center`, `rotation` and `radius` are all false: nothing is refined"
            fix = "set one of them to true, or use `qgs/none` in the slot `refinement`"
            yield Problem("", reason, fix)
        if not config.center:
            idle = ("center_step", "input_limit", "output_limit")
            yield from without_effect(config, idle, "`center` is false")
        elif config.center_step == "linear":
            idle = ("input_limit", "output_limit")
            yield from without_effect(config, idle, "`center_step` is linear")
        if not config.radius:
            yield from without_effect(config, ("radius_bound", "radius_min"), "`radius` is false")

    def forward(self, state: QueryState) -> QueryState:
        """A state with moved centres, turned rotations and changed raw radii."""
        refined: dict[str, Tensor] = {}
        if self.config.center:
            refined[CENTER] = state[CENTER] + self._center_step(state.features)
        if self.config.rotation:
            refined[ROTATION] = turned(state[ROTATION], self.rotation_mlp(state.features))
        if self.config.radius:
            step = at_least_float32(self.radius_mlp(state.features))
            refined[RAW_RADII] = state[RAW_RADII] + step
        return state.replace(fields=refined)

    def _center_step(self, features: Tensor) -> Tensor:
        step, config = self.center_mlp(features), self.config
        if config.center_step == "linear":
            return at_least_float32(step)
        return posact(step, config.input_limit, config.output_limit)

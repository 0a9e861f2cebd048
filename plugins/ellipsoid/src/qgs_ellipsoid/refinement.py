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
        """center, rotation, radii: what is refined; the last two are the shape.

        center_step, input_limit, output_limit, zero_init: see `locus/refine`.
        """

        center: bool = True
        rotation: bool = True
        radii: bool = True
        center_step: Literal["posact", "linear"] = "posact"
        input_limit: float | None = Field(default=100.0, gt=0)
        output_limit: float | None = Field(default=1000.0, gt=0)
        zero_init: bool = False

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        chosen = [name for name in ("center", "rotation", "radii") if getattr(config, name)]
        self.heads = nn.ModuleDict({name: Mlp(dims.width, dims.width, 3) for name in chosen})
        if config.zero_init:
            for head in self.heads.values():
                assert isinstance(head, Mlp)
                nn.init.zeros_(head.fc2.weight)
                nn.init.zeros_(head.fc2.bias)

    @classmethod
    def requires(cls, config: Config) -> Fields:
        """Whatever is refined."""
        parts = {"center": CENTER_FIELD, "rotation": ROTATION_FIELD, "radii": radii_field(config)}
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
            reason = "`center`, `rotation` and `radii` are all false: nothing is refined"
            fix = "set one of them to true, or use `qgs/none` in the slot `refinement`"
            yield Problem("", reason, fix)
        if not config.center:
            idle = ("center_step", "input_limit", "output_limit")
            yield from without_effect(config, idle, "`center` is false")
        elif config.center_step == "linear":
            idle = ("input_limit", "output_limit")
            yield from without_effect(config, idle, "`center_step` is linear")
        if not config.radii:
            yield from without_effect(config, ("radius_bound", "radius_min"), "`radii` is false")

    def forward(self, state: QueryState) -> QueryState:
        """A state with moved centres, turned rotations and changed raw radii."""
        step = {name: at_least_float32(head(state.features)) for name, head in self.heads.items()}
        refined: dict[str, Tensor] = {}
        if "center" in step:
            refined[CENTER] = state[CENTER] + self._moved(step["center"])
        if "rotation" in step:
            refined[ROTATION] = turned(state[ROTATION], step["rotation"])
        if "radii" in step:
            refined[RAW_RADII] = state[RAW_RADII] + step["radii"]
        return state.replace(fields=refined)

    def _moved(self, step: Tensor) -> Tensor:
        config = self.config
        if config.center_step == "linear":
            return step
        return posact(step, config.input_limit, config.output_limit)

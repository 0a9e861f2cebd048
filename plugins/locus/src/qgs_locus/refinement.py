"""`locus/refine`: update of the centres and radii of anchors after each decoder layer."""

from collections.abc import Iterable
from typing import Literal

from pydantic import PositiveFloat
from torch import Tensor, nn

from qgs.contracts import Fields, ModelDims, Problem, RecipeContext, Refinement, without_effect
from qgs.precision import at_least_float32
from qgs.tokengs import Mlp, posact
from qgs.types import QueryState
from qgs_locus.fields import CENTER, CENTER_FIELD, RadiusOptions, radius_field


class AnchorRefinement(Refinement):
    """Update of anchors after each layer: mu += posact(MLP_mu(x)), rho += MLP_rho(x).

    mu is the anchor's centre, rho its raw radius, x the query's features. posact(t) is
    sign(t) (exp|t| - 1). All layers share the two MLPs. This is equation (6) of the plugin's
    README.
    """

    name = "refine"
    parts = ("`center`", "`radius`")
    # Another anchor may have more radii.
    field_of_radius = staticmethod(radius_field)

    class Config(RadiusOptions):
        center: bool = True
        """Update anchor centres after each decoder layer. With false, they stay unchanged."""
        radius: bool = True
        """Update anchor radii after each decoder layer. With false, they stay unchanged."""
        center_step: Literal["posact", "linear"] = "posact"
        """Step of a centre for an output t of its MLP: posact(t) = sign(t) (exp|t| - 1) (LocusGS
        release), or t itself ("linear", LocusGS paper)."""
        input_limit: PositiveFloat | None = 100.0
        """Limit of outputs of the MLP of centres, from -input_limit to input_limit, with
        `center_step: posact`. Null means no limit."""
        output_limit: PositiveFloat | None = 1000.0
        """Limit of steps along each axis, from -output_limit to output_limit in world units, with
        `center_step: posact`. Null means no limit."""
        zero_init: bool = False
        """Initialise the last layer of each MLP with zeros, so that anchors do not move at first.
        With false, as in the LocusGS release, this layer is initialised randomly."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        # One pair of heads serves all layers: the composer shares modules of equal options.
        if config.center:
            self.center_mlp = self._head(3)
        if config.radius:
            # The spec has the channels.
            ((self.raw_radius, spec),) = self.field_of_radius(config).items()
            self.radius_mlp = self._head(int(spec.shape[0]))

    def _head(self, channels: int) -> Mlp:
        mlp = Mlp(self.dims.width, self.dims.width, channels)
        # The first layer stays random: if both were zero, neither would get a gradient.
        for parameter in mlp.fc2.parameters() if self.config.zero_init else ():
            nn.init.zeros_(parameter)
        return mlp

    @classmethod
    def fields_read(cls, config: Config) -> Fields:
        center = CENTER_FIELD if config.center else {}
        return {**center, **(cls.field_of_radius(config) if config.radius else {})}

    @classmethod
    def fields_written(cls, config: Config) -> Fields:
        return cls.fields_read(config)

    @classmethod
    def problems(cls, config: Config, context: RecipeContext) -> Iterable[Problem]:
        """Report a refinement that updates nothing, and options without effect."""
        if not cls.fields_read(config):
            yield Problem(
                "",
                f"nothing is refined: {', '.join(cls.parts)} are all false",
                "set one of them to true, or use `qgs/none` in the slot `refinement`",
            )
        limits = ("input_limit", "output_limit")
        if not config.center:
            yield from without_effect(config, ("center_step", *limits), "`center` is false")
        elif config.center_step == "linear":
            yield from without_effect(config, limits, "`center_step` is linear")
        if not config.radius:
            yield from without_effect(config, ("radius_bound", "radius_min"), "`radius` is false")

    def forward(self, state: QueryState) -> QueryState:
        """Return the state with updated centres and raw radii."""
        refined: dict[str, Tensor] = {}
        if self.config.center:
            refined[CENTER] = state[CENTER] + self.center_step(state)
        if self.config.radius:
            # The raw radius needs no bound: softplus keeps the radius positive.
            step = at_least_float32(self.radius_mlp(state.features))
            refined[self.raw_radius] = state[self.raw_radius] + step
        return state.replace(fields=refined)

    def center_step(self, state: QueryState) -> Tensor:
        """Return the steps of the centres (B, N, 3), world frame, in float32 or float64."""
        step_BN3 = self.center_mlp(state.features)
        if self.config.center_step == "posact":
            step_BN3 = posact(step_BN3, self.config.input_limit, self.config.output_limit)
        # Under autocast the step has half precision, which is too coarse for positions.
        return at_least_float32(step_BN3)

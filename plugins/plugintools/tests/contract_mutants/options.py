"""Components whose options are lost, lax or changed."""

from contract_mutants.mutant import mutant
from pydantic import BaseModel, ConfigDict, Field, field_serializer

from qgs.components import FreeCenters, MlpFeedForward
from qgs.contracts import ComponentConfig, FieldSpec
from qgs.losses import Opacity


@mutant("config_round_trip", "is read again as", options={"z_offset": 0.3})
class RoundsAnOption(FreeCenters):
    class Config(FreeCenters.Config):
        @field_serializer("z_offset")
        def _rounded(self, z_offset: float) -> float:
            return float(round(z_offset))


@mutant("config_round_trip", "shift is not written")
class LosesAnOption(FreeCenters):
    class Config(FreeCenters.Config):
        shift: float = Field(default=0.0, exclude=True)


@mutant("misspelt_option_is_refused", "`z_offset_x` is accepted")
class IgnoresUnknownOptions(FreeCenters):
    class Config(FreeCenters.Config):
        model_config = ConfigDict(extra="ignore")


class Inner(BaseModel):
    depth: float = 1.0


class Outer(ComponentConfig):
    inners: tuple[Inner, ...] = ()


@mutant("misspelt_option_is_refused", "Inner accepts any option")
class IgnoresUnknownInnerOptions(MlpFeedForward):
    class Config(MlpFeedForward.Config):
        outer: Outer | None = None


@mutant("options_are_left_alone", "when it is built, ")
class AppendsToAnOption(MlpFeedForward):
    class Config(MlpFeedForward.Config):
        sizes: list[int] = Field(default=[1])

    def __init__(self, config, dims):
        super().__init__(config, dims)
        config.sizes.append(2)


@mutant("scheduled_options_are_read_anew", "with `weight: 0.05` set after it was built")
class ReadsItsWeightOnce(Opacity):
    def __init__(self, config):
        super().__init__(config)
        self.weight = config.weight

    def term(self, prediction, rendering, target, inputs):
        opacities = prediction.gaussians.opacities
        return self.weight * -(opacities + self.config.eps).log().mean()


@mutant(
    "scheduled_options_are_read_anew",
    "with `eps: 5.0e-07` set after it was built",
    also="forward_keeps_no_state",
)
class KeepsWhatItMadeOfAnOption(Opacity):
    scheduled = frozenset({"weight", "eps"})
    made = None

    def term(self, prediction, rendering, target, inputs):
        self.made = self.config.eps if self.made is None else self.made
        opacities = prediction.gaussians.opacities
        return -(opacities + 1e4 * self.made).log().mean()


@mutant("scheduled_options_are_read_anew", "changes its `fields_read`", options={"weight": 0.0})
class RequiresWhatItsWeightSays(Opacity):
    @classmethod
    def fields_read(cls, config):
        return {"a.field": FieldSpec((3,))} if config.weight else {}

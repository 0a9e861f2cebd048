"""Components whose options are lost, lax or changed."""

from contract_mutants.mutant import mutant
from pydantic import BaseModel, ConfigDict, Field, field_serializer

from qgs.components import FreeCenters, MlpFeedForward
from qgs.contracts import ComponentConfig
from qgs.losses import Opacity


@mutant("config_round_trip", "is read again as", options={"z_offset": 0.3})
class RoundsAnOption(FreeCenters):
    class Config(FreeCenters.Config):
        @field_serializer("z_offset")
        def _rounded(self, z_offset: float) -> float:
            return float(round(z_offset))


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

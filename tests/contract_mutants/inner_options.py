"""Components whose options are lost, lax or changed in a place that one does not look at."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel, Field, field_serializer

from qgs.components import FreeCenters, MlpFeedForward
from qgs.contracts import ComponentConfig, ModelDims


class LosesAnOption(FreeCenters):
    name: ClassVar[str] = "loses_an_option"

    class Config(FreeCenters.Config):
        shift: float = Field(default=0.0, exclude=True)


class RoundsOtherValues(FreeCenters):
    """What it writes is right for its defaults."""

    name: ClassVar[str] = "rounds_other_values"

    class Config(FreeCenters.Config):
        @field_serializer("z_offset")
        def _rounded(self, z_offset: float) -> float:
            return float(f"{z_offset:.3g}")


class Inner(BaseModel):
    depth: float = 1.0


class Outer(ComponentConfig):
    inners: tuple[Inner, ...] = ()


class LaxInside(MlpFeedForward):
    name: ClassVar[str] = "lax_inside"

    class Config(MlpFeedForward.Config):
        outer: Outer | None = None


class AppendsToAnOption(MlpFeedForward):
    name: ClassVar[str] = "appends_to_an_option"

    class Config(MlpFeedForward.Config):
        sizes: list[int] = Field(default=[1])

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        config.sizes.append(2)

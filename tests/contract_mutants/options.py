"""Components that are sound but for their options, their declarations or how they are built."""

from __future__ import annotations

import os
from collections.abc import Iterable
from itertools import count
from typing import ClassVar

import torch
from pydantic import ConfigDict, field_serializer
from torch import nn

from qgs.components import FreeCenters, Mlp, MlpFeedForward
from qgs.contracts import (
    ComponentConfig,
    Fields,
    FieldSpec,
    ModelDims,
    Problem,
    RecipeContext,
)

_counter = count()


class LossyConfig(FreeCenters):
    name: ClassVar[str] = "lossy_config"

    class Config(FreeCenters.Config):
        @field_serializer("z_offset")
        def _rounded(self, z_offset: float) -> float:
            return float(round(z_offset))


class LaxConfig(FreeCenters):
    name: ClassVar[str] = "lax_config"

    class Config(FreeCenters.Config):
        model_config = ConfigDict(extra="ignore")


class ThawedConfig(FreeCenters):
    name: ClassVar[str] = "thawed_config"

    class Config(FreeCenters.Config):
        model_config = ConfigDict(frozen=False)


class NamesNoOption(FreeCenters):
    name: ClassVar[str] = "names_no_option"

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        yield Problem("z_ofset", "never fits", "there is none")


class ChangesItsMind(FreeCenters):
    name: ClassVar[str] = "changes_its_mind"

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        return {f"place.{next(_counter)}": FieldSpec((3,))}


class AllocatesOnCpu(MlpFeedForward):
    name: ClassVar[str] = "allocates_on_cpu"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.scale = nn.Parameter(torch.ones(dims.width, device="cpu"))


class HidesATensor(MlpFeedForward):
    name: ClassVar[str] = "hides_a_tensor"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.scale = torch.ones(dims.width)


class ReadsWhenBuilt(MlpFeedForward):
    name: ClassVar[str] = "reads_when_built"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        with open(os.devnull) as settings:
            settings.read()


class SeedsItself(MlpFeedForward):
    name: ClassVar[str] = "seeds_itself"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        torch.manual_seed(0)
        super().__init__(config, dims)


class DrawsElsewhere(MlpFeedForward):
    name: ClassVar[str] = "draws_elsewhere"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        generator = torch.Generator()
        generator.seed()
        with torch.no_grad():
            self.mlp.fc1.weight.normal_(generator=generator)


class RenamesItsParameters(MlpFeedForward):
    name: ClassVar[str] = "renames_its_parameters"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.register_parameter(f"scale_{next(_counter)}", nn.Parameter(torch.ones(dims.width)))


class KeepsItsNoise(MlpFeedForward):
    name: ClassVar[str] = "keeps_its_noise"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.register_buffer("noise", torch.randn(dims.width), persistent=False)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return super().forward(features) + self.noise


class DependsOnTheProcess(MlpFeedForward):
    name: ClassVar[str] = "depends_on_the_process"

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return super().forward(features) * (1 + os.getpid() % 997)


class HasADeadParameter(MlpFeedForward):
    name: ClassVar[str] = "has_a_dead_parameter"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.unused = nn.Linear(dims.width, dims.width)


class MovesItsNorm(MlpFeedForward):
    """Its parameters are not where saved weights have them."""

    name: ClassVar[str] = "moves_its_norm"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.layer_norm = self.norm
        del self.norm

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return self.mlp(self.layer_norm(features))


class HalvesItsMlp(MlpFeedForward):
    """Its parameters are not of the sizes that saved weights have."""

    name: ClassVar[str] = "halves_its_mlp"

    def __init__(self, config: MlpFeedForward.Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.mlp = Mlp(dims.width, 2 * dims.width, dims.width)

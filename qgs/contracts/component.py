"""What every component shares: a name, a Config, and what it reads and writes."""

from __future__ import annotations

from abc import ABC
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeAlias

import torch
from pydantic import BaseModel, ConfigDict


class OptionError(ValueError):
    """Raised by the validators of a Config: `reason` says what is wrong, `fix` what to write."""

    def __init__(self, reason: str, fix: str) -> None:
        super().__init__(f"{reason}; {fix}")
        self.reason = reason
        self.fix = fix


class ComponentConfig(BaseModel):
    """Options of a component: frozen, strict about types, unknown keys refused."""

    __component__: ClassVar[type[Component] | None] = None
    """The class whose options these are; None for settings that belong to none."""

    model_config = ConfigDict(
        frozen=True,
        strict=True,
        extra="forbid",
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )


@dataclass(frozen=True)
class FieldSpec:
    """A named tensor that one component leaves for later ones.

    shape: trailing shape after the leading (batch, item) dimensions; a str is a symbolic size such
        as "D".
    dtype: what the tensor is stored in.
    frame: the coordinate frame of its numbers.
    encoding: how raw numbers are to be read where more than one way exists; writer and reader must
        agree.
    """

    shape: tuple[int | str, ...]
    dtype: torch.dtype = torch.float32
    frame: Literal["none", "world", "camera"] = "none"
    encoding: str = ""

    def __str__(self) -> str:
        shape = "x".join(map(str, self.shape)) or "scalar"
        frame = "" if self.frame == "none" else f", {self.frame} frame"
        encoding = f", {self.encoding}" if self.encoding else ""
        return f"{shape} {str(self.dtype).removeprefix('torch.')}{frame}{encoding}"


Fields: TypeAlias = Mapping[str, FieldSpec]


@dataclass(frozen=True)
class ModelDims:
    """Sizes that all parts of one model share: width D, heads h, decoder depth L."""

    width: int
    heads: int
    depth: int


@dataclass(frozen=True)
class RecipeContext:
    """What a component may know of the rest of its recipe when its options are checked.

    image_size: (H, W) the data delivers; None when the recipe has no data.
    """

    dims: ModelDims
    image_size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Problem:
    """An option that does not fit the rest of the recipe.

    option: dotted path below the component, "" for the component itself.
    """

    option: str
    reason: str
    fix: str


def without_effect(
    config: ComponentConfig, options: Iterable[str], because: str
) -> Iterator[Problem]:
    """A problem for each of `options` that is not at its default although nothing reads it.

    because: what else in `config` makes them idle. Defaults pass: resolved recipes spell them out.
    """
    for option in options:
        default = type(config).model_fields[option].get_default()
        if getattr(config, option) != default:
            word = "null" if default is None else default
            fix = f"leave it at its default, {word}, or change what makes it idle"
            yield Problem(option, f"`{option}` has no effect: {because}", fix)


class Component(ABC):
    """Base of everything that a recipe can name.

    A slot's contract sets `slot`; a final class sets `name` and nests its `Config`. A recipe
    selects it as `type: PLUGIN/NAME`. Classmethods are called with a decoded config before
    anything is built.

    A forward pass treats scenes apart and changes neither its inputs nor what the component keeps,
    in training neither; there, and there alone, it may draw from torch's global generator. What it
    reads gets a gradient.
    """

    slot: ClassVar[str]
    name: ClassVar[str]

    class Config(ComponentConfig):
        """No options."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Give every class a Config of its own, which knows the class (see `component_of`)."""
        super().__init_subclass__(**options)
        inherited = cls.Config
        if not (isinstance(inherited, type) and issubclass(inherited, ComponentConfig)):
            return  # no sound component: whoever loads it says so
        if inherited.__qualname__ != f"{cls.__qualname__}.Config":
            own: dict[str, Any] = {"__qualname__": f"{cls.__qualname__}.Config"}
            own["__module__"] = cls.__module__
            # It has no options of its own; looking for their docstrings would take 15 ms.
            own["model_config"] = ConfigDict(use_attribute_docstrings=False)
            cls.Config = type("Config", (inherited,), own)
            cls.Config.model_config["use_attribute_docstrings"] = True  # for what inherits from it
        cls.Config.__component__ = cls

    @classmethod
    def requires(cls, config: ComponentConfig) -> Fields:
        """Fields that must exist before this component runs, as a function of its options."""
        return {}

    @classmethod
    def provides(cls, config: ComponentConfig) -> Fields:
        """Fields that exist once this component has run, as a function of its options."""
        return {}

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        """What is wrong with `config` beside the rest of the recipe; empty when it fits."""
        return ()


def component_of(config: ComponentConfig) -> type[Component]:
    """The class whose options `config` holds; raises TypeError for options of no component."""
    component = type(config).__component__ if isinstance(config, ComponentConfig) else None
    if component is None:
        raise TypeError(
            f"{type(config).__name__} holds options of no component; "
            "give the Config of a component class, such as MyAttention.Config()"
        )
    return component


class ModelComponent(Component, torch.nn.Module):
    """A component with parameters, built with the sizes that the whole model shares."""

    def __init__(self, config: ComponentConfig, dims: ModelDims) -> None:
        torch.nn.Module.__init__(self)
        self.config = config
        self.dims = dims

    def decays(self, name: str, parameter: torch.nn.Parameter) -> bool:
        """Whether weight decay applies to `parameter`, called `name` inside this component.

        By default to all but 1-d parameters (biases, norms, LayerScale), as in the LocusGS release.
        """
        return parameter.ndim != 1


class MissingExtraError(RuntimeError):
    """An optional package is needed; the message names it and the command that installs it."""

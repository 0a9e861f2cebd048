"""Base classes of all components, and classes for their options, fields and problems."""

from abc import ABCMeta
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import torch
from pydantic import BaseModel, ConfigDict


# A ValueError, because pydantic turns those into problems of the option.
class OptionError(ValueError):
    """Error that a validator of component options raises.

    reason: what is wrong. fix: what to write instead.
    """

    def __init__(self, reason: str, fix: str) -> None:
        super().__init__(f"{reason}; {fix}")
        self.reason = reason
        self.fix = fix


class ComponentConfig(BaseModel):
    """Options of a component: frozen, strict about types, without unknown keys.

    Document every option with a docstring below it: meaning, unit, what null or 0 means.
    """

    __component__: ClassVar["type[Component] | None"] = None
    """Component class with these options. None for recipe sections such as `training`."""

    model_config = ConfigDict(
        # Checkpoints and hashes contain the options, so they must not change later.
        frozen=True,
        # `count: "8"` is probably a mistake, so it is not read as 8.
        strict=True,
        extra="forbid",
        # NaN would pass every limit and make the loss NaN.
        allow_inf_nan=False,
        # Editors show them through the JSON Schema, terminals through `qgs list`.
        use_attribute_docstrings=True,
    )


@dataclass(frozen=True)
class FieldSpec:
    """Description of a named tensor that one component writes and later components read.

    shape: sizes of all axes but the first two, which are scenes and queries (or tokens). A str
        is a symbolic size, such as "D".
    frame: the coordinate frame of the tensor's numbers, "none", "world" or "camera".
    encoding: a name for the meaning of numbers that could be read in several ways. The writing and
        the reading component must use the same name.
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


Fields = Mapping[str, FieldSpec]


@dataclass(frozen=True)
class ModelDims:
    """Sizes that all parts of a model share: width D, heads h, number of decoder layers."""

    width: int
    heads: int
    depth: int


@dataclass(frozen=True)
class RecipeContext:
    """Facts about a recipe that `Component.problems` of each of its components can use.

    image_size: (H, W) of the data's images; None for a recipe without data.
    inputs: number of input views in a training sample; None for a recipe without data.
    times: True if photos of the data may have times.
    """

    dims: ModelDims
    image_size: tuple[int, int] | None = None
    inputs: int | None = None
    times: bool = False


@dataclass(frozen=True)
class Problem:
    """Mistake in an option of a component, and how to fix it.

    option: dotted path of the option inside the component; "" for the component itself. reason:
    what is wrong.
    """

    option: str
    reason: str
    # The fix may differ with the installed components, so it does not count for equality.
    fix: str = field(compare=False)


def without_effect(
    config: ComponentConfig, options: Iterable[str], because: str
) -> Iterator[Problem]:
    """Yield a problem for each name in `options` whose value in `config` is not its default.

    None of these options has an effect, because of the setting `because`. Options that keep their
    defaults are no problem.
    """
    for option in options:
        default = type(config).model_fields[option].get_default()
        if getattr(config, option) != default:
            # As a recipe writes it.
            word = "null" if default is None else default
            fix = f"leave it at its default, {word}, or change the setting that disables it"
            yield Problem(option, f"`{option}` has no effect: {because}", fix)


class Component(metaclass=ABCMeta):
    """Base of everything that a recipe selects with `type: PLUGIN/NAME`.

    The abstract class of a slot sets `slot`. A component sets `name` and nests a class `Config`
    with its options. Classmethods are called with a valid config, before any component is built.

    Rules for `forward`: It treats the scenes of a batch independently. It changes no inputs,
    parameters or buffers. It draws random numbers only in training, from torch's global generator.
    It propagates gradients to every tensor that it reads.
    """

    slot: ClassVar[str]
    name: ClassVar[str]
    reads: ClassVar[Fields] = {}
    """Fields that must exist before this component runs. If they depend on options, override
    `fields_read`."""
    writes: ClassVar[Fields] = {}
    """Fields that exist after this component has run. If they depend on options, override
    `fields_written`."""
    scheduled: ClassVar[frozenset[str]] = frozenset()
    """Numeric options that a schedule in the recipe may change from step to step. The component
    must read them from `self.config` in every call; a value stored elsewhere would not change."""

    schedules: Mapping[str, Any] = MappingProxyType({})
    """The `qgs.contracts.schedule.Schedule` of each scheduled option, by name of the option. In
    `config`, these options have their values after n optimiser steps; `followed` is n."""
    followed: int = 0

    class Config(ComponentConfig):
        """Options of the component; there are none by default."""

    def __init__(self, config: ComponentConfig) -> None:
        super().__init__()
        self.config = config

    def __init_subclass__(cls) -> None:
        """Give every subclass its own Config class, with a reference to the subclass."""
        super().__init_subclass__()
        # A Config stores its component, so components must not share one.
        if cls.Config.__qualname__ != f"{cls.__qualname__}.Config":

            class Config(cls.Config):
                __module__ = cls.__module__
                __qualname__ = f"{cls.__qualname__}.Config"
                # It has no own options, and a search for their docstrings would take 15 ms.
                model_config = ConfigDict(use_attribute_docstrings=False)

            Config.model_config["use_attribute_docstrings"] = True  # for subclasses
            cls.Config = Config
        cls.Config.__component__ = cls

    @classmethod
    def fields_read(cls, config: ComponentConfig) -> Fields:
        """Return the fields that must exist before this component runs (default: `reads`)."""
        return cls.reads

    @classmethod
    def fields_written(cls, config: ComponentConfig) -> Fields:
        """Return the fields that exist after this component has run (default: `writes`)."""
        return cls.writes

    @classmethod
    def problems(cls, config: ComponentConfig, context: RecipeContext) -> Iterable[Problem]:
        """Return the problems of options that do not fit each other or the rest of the recipe."""
        return ()

    def load_pretrained(self) -> None:  # noqa: B027 (most have no such files)
        """Read weights from files that options name.

        Called once after the component is built. Not called on the meta device, nor if a checkpoint
        contains all weights. Raises MissingExtraError for a missing file or package; the message
        says what to do.
        """


class ModelComponent(Component, torch.nn.Module):
    """Component with parameters. It is built with the sizes that all parts of a model share."""

    def __init__(self, config: ComponentConfig, dims: ModelDims) -> None:
        super().__init__(config)
        self.dims = dims

    def decays(self, name: str, parameter: torch.nn.Parameter) -> bool:
        """Return whether weight decay applies to `parameter`, called `name` inside this component.

        By default, weight decay applies to all parameters except 1-d ones, which are biases, norms
        and LayerScales (LocusGS release).
        """
        # A norm or LayerScale that decays to 0 would switch off its layer.
        return parameter.ndim != 1

    def adapted(self, learned: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return a state dict for this component, made from the weights of another model.

        learned: state dict of the component in the same slot of the other model; it may be empty.
        Training with `init_from` calls this method of encoder, feedback and head. Weights that
        cannot be converted to this component's shapes are returned unchanged; loading then refuses
        them.
        """
        return dict(learned)


class MissingExtraError(RuntimeError):
    """Error for a missing optional package or file. The message says how to install it."""

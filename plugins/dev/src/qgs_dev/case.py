"""A component with options and sizes, as the checks see it, and the errors that checks raise."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import torch
from pydantic_core import to_jsonable_python
from torch import nn
from torch.nn import Module

from qgs import contracts
from qgs.contracts import (
    Component,
    ComponentConfig,
    Fields,
    Metric,
    ModelDims,
    Objective,
    Optimizer,
    Renderer,
    ViewSampler,
)
from qgs.recipe.build import load_pretrained
from qgs.recipe.yaml_text import dump
from qgs.tokengs import ContentCrossAttention, ContentSelfAttention, MlpFeedForward
from qgs_dev.modules import seeded

# The least that has two heads and a layer after the first: checks take seconds for a plugin.
SMALL = ModelDims(width=32, heads=2, depth=2)

# Sizes that are tried in turn until the component's `problems` accepts one.
IMAGE_SIZES = ((16, 24), (24, 16), (28, 42), (32, 48), (64, 96))

# Components in the slots of a decoder layer.
SUBLAYERS: Mapping[str, Any] = {
    "cross_attention": ContentCrossAttention,
    "self_attention": ContentSelfAttention,
    "feed_forward": MlpFeedForward,
}

# Large enough for what stands in the slots to show in the output of a layer.
LAYER_SCALE = 0.3

# Added to parameters where initial zeros would hide what a component does.
NOISE = 0.1


class ContractError(AssertionError):
    """A component does not keep its contract; the message says what it did instead."""


class CannotCheck(Exception):  # noqa: N818 (not an error: the reason of a skip)
    """A check cannot be run here; the message is the reason."""


@dataclass(frozen=True)
class Case:
    """A component to check: `Case(MyAttention.Config(bandwidth="fixed"))`.

    config: options of a component; the class that nests it is the one checked.
    dims: sizes to build it with. image_size: (H, W) of the views; None tries a few small ones.
    state_dict: name -> shape of every entry, pinned, so that saved weights stay loadable; None
        pins nothing.
    Raises TypeError for anything but the options of a complete component.
    """

    config: ComponentConfig
    dims: ModelDims = SMALL
    image_size: tuple[int, int] | None = None
    state_dict: Mapping[str, tuple[int, ...]] | None = None

    def __post_init__(self) -> None:
        fault = component_fault(self.component)
        if fault:
            raise TypeError(f"{self.component.__qualname__} cannot be checked: {fault}")

    @property
    def component(self) -> type[contracts.Component]:
        """The class under test."""
        component = self.config.__component__
        assert component is not None
        return component

    @property
    def slot(self) -> str:
        """The slot that it fills."""
        return self.component.slot

    @property
    def reads(self) -> Fields:
        """The fields that it requires."""
        return self.component.fields_read(self.config)

    @property
    def writes(self) -> Fields:
        """The fields that it provides."""
        return self.component.fields_written(self.config)

    @property
    def has_parameters(self) -> bool:
        """True for a component that is built with the sizes of the model."""
        return issubclass(self.component, contracts.ModelComponent)

    # Every check of the case is named by it.
    @cached_property
    def label(self) -> str:
        """Slot and name, and the options that differ from their defaults, in YAML."""
        given = dict(self.config)
        changed = {
            name: given[name]
            for name, option in type(self.config).model_fields.items()
            if given[name] != option.get_default()
        }
        written = dump(to_jsonable_python(changed, fallback=repr), flow=True).strip()
        options = f"({written[1:-1]})" if changed else ""
        return f"{self.slot}/{self.component.name}{options}"

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the views."""
        if self.image_size is not None:
            return self.image_size
        return next((size for size in IMAGE_SIZES if not self.problems(size)), IMAGE_SIZES[0])

    @property
    def device(self) -> str:
        """The CPU if it can run there, else its GPU; raises CannotCheck if that is missing."""
        devices = getattr(self.component, "devices", ("cpu",))
        if "cpu" in devices:
            return "cpu"
        if "cuda" in devices and torch.cuda.is_available():
            return "cuda"
        raise CannotCheck(f"runs on {' or '.join(devices)} alone, which is not here")

    def problems(self, size: tuple[int, int] | None = None) -> list[contracts.Problem]:
        """Return what the component says of its options, with images of `size`."""
        context = contracts.RecipeContext(self.dims, size)
        return list(self.component.problems(self.config, context))

    def build(self, seed: int = 0) -> Any:
        """A new instance, parameters drawn under `seed`. CannotCheck where its data is missing."""
        try:
            with seeded(seed):
                built = self.construct()
        except FileNotFoundError as error:
            if self.slot != "data":
                raise
            # Data sets are gigabytes, and here or not; any other file belongs to the component.
            raise CannotCheck(f"the data of this case is not here: {error}") from error
        return built.to(self.device) if isinstance(built, nn.Module) else built

    def construct(self) -> Any:
        """A new instance, drawn from the global random state."""
        # The three kinds of constructors: of a layer, with the sizes of the model, with options
        # alone.
        make: Any = self.component
        if issubclass(make, contracts.DecoderLayer):
            parts = {}
            for slot in make.sublayers:
                part = SUBLAYERS[slot]
                parts[slot] = part(part.Config(), self.dims)
            return make(self.config, contracts.LayerParts(self.dims, parts, LAYER_SCALE))
        built = make(self.config, self.dims) if self.has_parameters else make(self.config)
        if isinstance(built, nn.Module):
            load_pretrained(built)
        return built

    def lively(self, seed: int = 0) -> Any:
        """An instance in evaluation mode in which no parameter is zero by initialisation."""
        module = self.build(seed).eval()
        generator = torch.Generator().manual_seed(seed + 1)
        with torch.no_grad():
            for parameter in module.parameters():
                parameter += NOISE * torch.randn(parameter.shape, generator=generator).to(parameter)
        return module

    def with_at_most(self, **sizes: int) -> "Case":
        """Return a case whose larger options are lowered to these, or itself if it refuses that."""
        given = dict(self.config)
        lower = {name: size for name, size in sizes.items() if (given.get(name) or 0) > size}
        smaller = self.with_config(self.config.model_copy(update=lower))
        return self if smaller.problems(smaller.size) else smaller

    def with_config(self, config: ComponentConfig) -> "Case":
        """Return the same case with other options."""
        return replace(self, config=config)

    def with_dims(self, **sizes: int) -> "Case":
        """Return the same component in a model of other sizes."""
        return replace(self, dims=replace(self.dims, **sizes))


# Types of the devices that a renderer can render on.
DEVICES = ("cpu", "cuda", "mps")


def component_fault(component: type[Component]) -> str:
    """Why a recipe cannot use the class `component`, as a relative clause; "" if it can."""
    name = getattr(component, "name", None)
    if not isinstance(name, str):
        return "which has no `name`"
    # Else `type: PLUGIN/NAME` would be ambiguous.
    if not re.fullmatch(r"[^\s/]+", name):
        return f"whose name {name!r} is empty or has a slash or a blank"
    if issubclass(component, Renderer):
        given: object = component.devices
        if not (isinstance(given, tuple) and given and set(given) <= set(DEVICES)):
            return f"whose `devices` is {given!r}; give some of {DEVICES} as a tuple"
    if issubclass(component, Metric) and not getattr(component, "definition", ""):
        return "which gives no `definition`; describe what it measures, since protocols hash it"
    config = component.Config
    if not config.model_config.get("frozen"):
        return "whose Config is not frozen; leave `frozen` of its `model_config` at True"
    if "type" in config.model_fields:
        return "whose Config has an option `type`, which names the component itself"
    fields: Mapping[str, Any] = config.model_fields
    scheduled: object = component.scheduled
    known = {n for n, option in fields.items() if _number_kinds(option.annotation)}
    if not (isinstance(scheduled, frozenset) and scheduled <= known):
        return f"whose `scheduled` is {scheduled!r}, not a frozenset of options that are numbers"
    # Others are built once, and have no step to follow.
    if scheduled and not issubclass(component, Module | Objective | Optimizer | ViewSampler):
        return f"which lists `scheduled` options; those of the slot `{component.slot}` stay"
    return ""


def _number_kinds(annotation: Any) -> set[type]:
    """Kinds of int and float that an option of this type can hold; none where it is no number."""
    if annotation in (int, float):
        return {annotation}
    # `float | None`, and numbers with limits; a list of numbers is no number.
    parts = get_args(annotation) if get_origin(annotation) in (Union, UnionType, Annotated) else ()
    return {kind for part in parts for kind in _number_kinds(part)}

"""A component with options and sizes, as the checks see it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from pydantic_core import to_jsonable_python
from torch import Tensor, nn

from qgs.composer.registry import component_fault
from qgs.composer.yaml_text import dump
from qgs.contracts import (
    Component,
    ComponentConfig,
    ModelComponent,
    ModelDims,
    Problem,
    RecipeContext,
    Renderer,
    component_of,
)
from qgs.testing.arguments import (
    refuse_other_dims,
    refuse_other_makers,
    refuse_other_shapes,
    refuse_other_size,
)
from qgs.testing.chance import drawn_from
from qgs.testing.faults import CannotCheck
from qgs.testing.wording import case_of, named

SMALL = ModelDims(width=32, heads=2, depth=2)

IMAGE_SIZES = ((16, 24), (24, 16), (28, 42), (32, 48), (64, 96))
"""Sizes that are tried, in turn, until the component's `problems` accepts one."""

LIVELINESS = 0.1
"""Noise on parameters where initial zeros would hide what a component does."""


@dataclass(frozen=True)
class Case:
    """A component to check: `Case(MyAttention.Config(bandwidth="fixed"))`.

    config: options of a component; the class that nests it is the one checked.
    dims: sizes to build it with. image_size: (H, W) of the views; None tries a few small ones.
    fields: for state fields that cannot hold just any number, name -> what makes a valid field
        of normally distributed numbers, such as `{"my.quat": lambda x: F.normalize(x, dim=-1)}`.
    state_dict: name -> shape of every entry, pinned, so that saved weights stay loadable; None
        pins nothing.
    Raises TypeError for what is no options, and for those of no component that recipes could name;
    TypeError or ValueError for sizes, fields and shapes that are none.
    """

    config: ComponentConfig
    dims: ModelDims = SMALL
    image_size: tuple[int, int] | None = None
    fields: Mapping[str, Callable[[Tensor], Tensor]] = field(default_factory=dict)
    state_dict: Mapping[str, tuple[int, ...]] | None = None

    def __post_init__(self) -> None:
        if inspect.isclass(self.config) or isinstance(self.config, Component):
            raise TypeError(f"{named(self.config)} is no options; write {case_of(self.config)}")
        component = component_of(self.config)
        fault = component_fault(component)
        if fault:
            raise TypeError(f"no case can be made of {component.__qualname__}, {fault}")
        refuse_other_dims(self.dims)
        refuse_other_size(self.image_size)
        refuse_other_shapes(self.state_dict)
        if self.fields:
            read, written = component.requires(self.config), component.provides(self.config)
            refuse_other_makers(self.fields, {*read, *written})

    @property
    def component(self) -> type[Component]:
        """The class under test."""
        return component_of(self.config)

    @property
    def slot(self) -> str:
        """The slot that it fills."""
        return self.component.slot

    @property
    def has_parameters(self) -> bool:
        """Whether it is built with the sizes of the model."""
        return issubclass(self.component, ModelComponent)

    @property
    def label(self) -> str:
        """Slot and name, and the options that differ from their defaults, in YAML."""
        changed = [
            _in_yaml(name, getattr(self.config, name))
            for name, option in type(self.config).model_fields.items()
            if option.is_required() or getattr(self.config, name) != option.get_default()
        ]
        options = f"({', '.join(changed)})" if changed else ""
        return f"{self.slot}/{self.component.name}{options}"

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the views."""
        if self.image_size is not None:
            return self.image_size
        return next((size for size in IMAGE_SIZES if not self.problems(size)), IMAGE_SIZES[0])

    @property
    def device(self) -> str:
        """Where it runs: the CPU, if it can. Raises CannotCheck where its device is missing."""
        component = self.component
        if not issubclass(component, Renderer) or "cpu" in component.devices:
            return "cpu"
        if "cuda" in component.devices and torch.cuda.is_available():
            return "cuda"
        raise CannotCheck(f"runs on {' or '.join(component.devices)} alone, which is not here")

    def problems(self, size: tuple[int, int] | None = None) -> list[Problem]:
        """What the component says of its options, with images of `size`."""
        return list(self.component.problems(self.config, RecipeContext(self.dims, size)))

    def build(self, seed: int = 0) -> Any:
        """A new instance with initial parameters drawn from `seed`, as the composer draws them."""
        with drawn_from(seed):
            built = self.construct()
        return built.to(self.device) if isinstance(built, nn.Module) else built

    def construct(self) -> Any:
        """A new instance, drawn from the global random state."""
        make: Any = self.component
        return make(self.config, self.dims) if self.has_parameters else make(self.config)

    def lively(self, seed: int = 0) -> Any:
        """An instance for evaluation in which no parameter is zero by initialisation."""
        module = self.build(seed).eval()
        generator = torch.Generator().manual_seed(seed + 1)
        with torch.no_grad():
            for parameter in module.parameters():
                noise = torch.randn(parameter.shape, generator=generator)
                parameter += LIVELINESS * noise.to(parameter)
        return module

    def with_dims(self, **sizes: int) -> Case:
        """The same component in a model of other sizes."""
        return replace(self, dims=replace(self.dims, **sizes), state_dict=None)


def _in_yaml(option: str, value: Any) -> str:
    """`option: value`, of an option that recipes cannot express too."""
    written = {option: to_jsonable_python(value, fallback=repr)}
    return dump(written, flow=True).strip().removeprefix("{").removesuffix("}")

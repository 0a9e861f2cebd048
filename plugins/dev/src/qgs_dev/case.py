"""Cases of the contract suite (a component with options and sizes), and errors of checks."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import nn

from qgs import contracts
from qgs.contracts import Component, ComponentConfig, Fields, Metric, ModelDims
from qgs.recipe.build import load_pretrained
from qgs.recipe.yaml_text import dump
from qgs.tokengs import ContentCrossAttention, ContentSelfAttention, MlpFeedForward
from qgs.types import Size

# The smallest model with two heads and two layers, so that the checks of a plugin take seconds.
SMALL = ModelDims(width=32, heads=2, depth=2)

# Image sizes to try in turn until the component's `problems` accepts one.
IMAGE_SIZES = ((16, 24), (24, 16), (28, 42), (32, 48), (64, 96))

# Components in the slots of a decoder layer.
SUBLAYERS: Mapping[str, Any] = {
    "cross_attention": ContentCrossAttention,
    "self_attention": ContentSelfAttention,
    "feed_forward": MlpFeedForward,
}

# Large enough that the sublayers change the output of a layer.
LAYER_SCALE = 0.3

# Added to parameters, because initial zeros would hide what a component does.
NOISE = 0.1


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Set torch's random seed inside a `with` block, and restore the random state afterwards."""
    with torch.random.fork_rng(devices=()):
        torch.default_generator.manual_seed(seed)
        yield


class ContractError(AssertionError):
    """Error for a component that breaks its contract. The message says what the component did."""


class CannotCheck(Exception):  # noqa: N818 (not an error: the reason of a skip)
    """Error for a check that cannot run on this component or machine. The message is the reason."""


@dataclass(frozen=True)
class Case:
    """Component to check, with options and sizes: `Case(MyAttention.Config(bandwidth="fixed"))`.

    config: options of the component; the class in which this `Config` is nested is checked.
    dims: model sizes with which the component is built.
    image_size: (H, W) of the views in pixels; None takes the first valid of a few small sizes.
    state_dict: expected shapes of all saved weights, by name, so that published weights stay
        loadable; None allows any names and shapes.
    Raises TypeError unless `config` holds the options of a complete component.
    """

    config: ComponentConfig
    dims: ModelDims = SMALL
    image_size: Size | None = None
    state_dict: Mapping[str, tuple[int, ...]] | None = None

    def __post_init__(self) -> None:
        fault = component_fault(self.component)
        if fault:
            raise TypeError(f"{self.component.__qualname__} cannot be checked: it {fault}")

    @property
    def component(self) -> type[contracts.Component]:
        """Class of the component."""
        component = self.config.__component__
        assert component is not None
        return component

    @property
    def slot(self) -> str:
        """Slot that the component fills."""
        return self.component.slot

    @property
    def reads(self) -> Fields:
        """Specifications of the fields that the component requires, by name."""
        return self.component.fields_read(self.config)

    @property
    def writes(self) -> Fields:
        """Specifications of the fields that the component provides, by name."""
        return self.component.fields_written(self.config)

    @property
    def has_parameters(self) -> bool:
        """True if the component is built with the sizes of the model, so it may have parameters."""
        return issubclass(self.component, contracts.ModelComponent)

    # Reports name every check of the case by it.
    @cached_property
    def label(self) -> str:
        """Slot and name of the component, and the options that are not default, as YAML."""
        changed = {*self.config.model_dump(exclude_defaults=True)}
        shown = self.config.model_dump(mode="json", include=changed, fallback=repr)
        written = dump(shown, flow=True).strip()
        options = f"({written[1:-1]})" if changed else ""
        return f"{self.slot}/{self.component.name}{options}"

    @property
    def size(self) -> Size:
        """Size (H, W) of the views in pixels."""
        if self.image_size is not None:
            return self.image_size
        return next((size for size in IMAGE_SIZES if not self.problems(size)), IMAGE_SIZES[0])

    @property
    def device(self) -> str:
        """Device for the checks: "cpu" if the component supports it, otherwise "cuda".

        Raises CannotCheck if this machine has no device that the component supports.
        """
        devices = getattr(self.component, "devices", ("cpu",))
        if "cpu" in devices:
            return "cpu"
        if "cuda" in devices and torch.cuda.is_available():
            return "cuda"
        raise CannotCheck(f"runs only on {' or '.join(devices)}, which this machine does not have")

    def problems(self, size: Size | None = None) -> list[contracts.Problem]:
        """Return the problems that the component reports for its options and images of `size`.

        size: (H, W), by default `self.size`.
        """
        context = contracts.RecipeContext(self.dims, size or self.size)
        return list(self.component.problems(self.config, context))

    def build(self, seed: int = 0) -> Any:
        """Return a new instance, with random initial parameters from `seed`.

        Raises CannotCheck if the data set of a data source is missing.
        """
        try:
            with seeded(seed):
                built = self.construct()
        except FileNotFoundError as error:
            if self.slot != "data":
                raise
            # A data set of gigabytes may be missing; any other file belongs to the component.
            raise CannotCheck(f"the data set of this case is missing: {error}") from error
        return built.to(self.device) if isinstance(built, nn.Module) else built

    def construct(self) -> Any:
        """Return a new instance, with initial parameters from torch's global random generator."""
        # There are three kinds of constructors: of a layer, of a component that takes the sizes of
        # the model, and of one that takes only options.
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
        """Return a new instance in evaluation mode, with random noise added to all parameters."""
        module = self.build(seed).eval()
        with seeded(seed + 1), torch.no_grad():
            for parameter in module.parameters():
                parameter += NOISE * torch.randn(parameter.shape).to(parameter)
        return module

    def with_at_most(self, **sizes: int) -> "Case":
        """Return a copy in which options named in `sizes` are at most the values given there.

        Return this case unchanged if the component reports problems with the new options.
        """
        given = dict(self.config)
        lower = {name: size for name, size in sizes.items() if (given.get(name) or 0) > size}
        smaller = self.with_config(self.config.model_copy(update=lower))
        return self if smaller.problems() else smaller

    def with_config(self, config: ComponentConfig) -> "Case":
        """Return a copy of this case with the options `config`."""
        return replace(self, config=config)

    def with_dims(self, **sizes: int) -> "Case":
        """Return a copy of this case with the given model sizes."""
        return replace(self, dims=replace(self.dims, **sizes))


def component_fault(component: type[Component]) -> str:
    """Return why recipes cannot use `component`, such as "has no `name`"; "" if they can."""
    name = getattr(component, "name", None)
    if not isinstance(name, str):
        return "has no `name`"
    # Otherwise `type: PLUGIN/NAME` would be ambiguous.
    if not re.fullmatch(r"[^\s/]+", name):
        return f"has the `name` {name!r}; use at least one character, and no slash or space"
    if issubclass(component, Metric) and not getattr(component, "definition", ""):
        return "has no `definition`; describe what it measures (protocols hash this text)"
    if "type" in component.Config.model_fields:
        return "has an option `type`; rename it, because `type` names the component in a recipe"
    return ""

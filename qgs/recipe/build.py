"""Construction of a recipe's model, and the learning-rate factors of its parameters."""

from collections.abc import Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from qgs.containers import named_tensors
from qgs.contracts import (
    SUBLAYER_SLOTS,
    Component,
    LayerParts,
    MissingExtraError,
    ModelComponent,
    Optimizer,
    Refinement,
    SceneSource,
)
from qgs.machine import is_out_of_memory
from qgs.model import QueryGaussianModel
from qgs.recipe.decode import Chosen, report_failure
from qgs.recipe.errors import Problems, RecipeError
from qgs.recipe.places import matches
from qgs.recipe.registry import BUILTIN
from qgs.recipe.slots import AFTER_LAYERS
from qgs.recipe.yaml_text import KeyPath
from qgs.wording import did_you_mean

if TYPE_CHECKING:
    from qgs.recipe.recipe import Recipe


def build_model(recipe: "Recipe", device: torch.device | str | None) -> QueryGaussianModel:
    """Build the model of a checked recipe; on the device "meta", no memory is allocated.

    Initial parameters are sampled on the CPU from the recipe's seed, whatever `device` is. The
    global random state does not change.
    """
    on_meta = device is not None and torch.device(device).type == "meta"
    with (
        # Composing a model must not change random numbers that a script draws later.
        torch.random.fork_rng(devices=()),
        torch.device("meta" if on_meta else "cpu"),
        OnMeta() if on_meta else nullcontext(),
    ):
        torch.default_generator.manual_seed(recipe.seed)
        model = _assemble(recipe)
    # Drawn on the CPU first: every device begins with the same numbers.
    return model if on_meta or device is None else model.to(device)


def _assemble(recipe: "Recipe") -> QueryGaussianModel:
    shared: list[tuple[Chosen, nn.Module]] = []

    def at(*path: str) -> Any:
        chosen = recipe.parts["model", *path]
        for known, built in shared:
            # LocusGS refines after all layers with the same weights.
            if known.equals(chosen):
                return built
        sized = issubclass(chosen.component, ModelComponent)
        built = build(chosen, recipe.dims) if sized else build(chosen)
        if issubclass(chosen.component, Refinement) and chosen.component.shared_by_layers:
            shared.append((chosen, built))
        return built

    # The order is fixed: each component draws its parameters after the one before it.
    encoder = at("encoder")
    queries = at("queries")
    decoder = []
    refinements = []
    for index in range(recipe.dims.depth):
        path = ("decoder", "layers", str(index))
        sublayers = {
            slot: at(*path, slot)
            for slot in SUBLAYER_SLOTS
            if ("model", *path, slot) in recipe.parts
        }
        layer_parts = LayerParts(recipe.dims, sublayers, recipe.layer_scale)
        decoder.append(build(recipe.parts["model", *path, "layer"], layer_parts))
        refinements.append(at(*path, "refinement"))
    return QueryGaussianModel(
        encoder=encoder,
        queries=queries,
        decoder=decoder,
        refinements=refinements,
        recipe=recipe.tree,
        **{name: at(name) for name in AFTER_LAYERS},
    )


class OnMeta(TorchFunctionMode):
    """Mode that speeds up constructors of components on torch's meta device.

    `linspace` computes its values, because DINO's constructor reads them. Initialisers of weights
    do nothing. `randn` and arithmetic on float32 tensors compute only shapes; otherwise torch would
    import its compiler, which takes 1 to 3 s.
    """

    arithmetic = frozenset({Tensor.add, Tensor.sub, Tensor.mul, Tensor.__rpow__})
    # torch turns the mode off inside of its initialisers, so that they are caught as well.
    draws = frozenset({nn.init.normal_, Tensor.normal_})

    def __torch_function__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if func is torch.linspace:
            return func(*args, **{"device": "cpu", **kwargs})
        if func is torch.randn and not kwargs:
            return torch.empty(*args)
        tensors = [x for _, x in named_tensors([args, kwargs])]
        if all(x.is_meta and x.dtype is torch.float32 for x in tensors):
            if func in self.draws:
                return tensors[0]
            if func in self.arithmetic:
                return torch.empty(np.broadcast_shapes(*(x.shape for x in tensors)))
            if func is torch.cat:
                dim = kwargs.get("dim", args[1] if len(args) > 1 else 0)
                shape = list(tensors[0].shape)
                shape[dim] = sum(x.shape[dim] for x in tensors)
                return torch.empty(shape)
        return func(*args, **kwargs)


def build(chosen: Chosen, *arguments: Any) -> Any:
    """Build a component. arguments: further arguments of its constructor, after the Config.

    If the constructor of a plugin's component fails, raises RecipeError that names the plugin's
    distribution. Errors that a user can mend are not converted: missing packages or data, and
    training too short for the optimiser.
    """
    component: Any = chosen.component
    try:
        built = component(chosen.config, *arguments)
    except Exception as error:
        users_mistake = isinstance(error, MissingExtraError) or (
            isinstance(error, ValueError | OSError)
            and issubclass(component, SceneSource | Optimizer)
        )
        if users_mistake or is_out_of_memory(error) or chosen.installed is BUILTIN:
            raise
        called = f"`__init__` of `{chosen.type}`"
        problems = Problems()
        report_failure(chosen, called, error, chosen.installed, problems)
        raise RecipeError(problems.found) from error
    if chosen.schedules:
        built.schedules = chosen.schedules
    return built


def load_pretrained(*parts: nn.Module) -> None:
    """Call `load_pretrained` of every component in `parts`, except on the meta device.

    Raises MissingExtraError that names the component if a package it needs is missing.
    """
    for component in nn.ModuleList(parts).modules():
        if isinstance(component, Component) and not any(x.is_meta for x in component.parameters()):
            try:
                component.load_pretrained()
            except MissingExtraError as error:
                what = f"{component.slot} `{component.name}`"
                raise MissingExtraError(f"{what} cannot be used: {error}") from error


def rate_factors(module: nn.Module, optimizer: Chosen) -> dict[str, float]:
    """Return the learning-rate factor of every parameter of `module`, by parameter name.

    The factor is 1 unless a pattern in `optimizer.parts` matches the parameter. A parameter that
    several modules share appears once, under its first name.
    module: a model, or a module that holds a model and its losses.
    Raises RecipeError for a pattern that matches no parameter. Patterns for `losses` are not
    checked if `module` is a model.
    """
    config: Any = optimizer.config
    model = next(m for m in module.modules() if isinstance(m, QueryGaussianModel))
    factors = {name: 1.0 for name, _ in module.named_parameters()}
    paths = {name: _paths(name.removeprefix("model."), model) for name in factors}
    problems = Problems()
    for pattern, factor in config.parts.items():
        named = [
            name
            for name in factors
            if any(matches(pattern, path, below=True) for path in paths[name])
        ]
        factors |= dict.fromkeys(named, float(factor))
        # The trained module has the model as `model`, a recipe its parts in the section `model`.
        wanted = pattern.removeprefix("model.").split(".")
        if not named and (module is not model or wanted[0] != "losses"):
            known = {".".join(path[: len(wanted)]) for below in paths.values() for path in below}
            reason = f"the pattern `{pattern}` matches no parameter of the model"
            origin = optimizer.node.child("parts").origin_of(pattern)
            fix = did_you_mean(pattern.removeprefix("model."), known, "parts")
            problems.add(origin, f"optimizer.parts.{pattern}", reason, fix)
    problems.raise_any()
    return factors


def _paths(name: str, model: QueryGaussianModel) -> list[KeyPath]:
    """Return all paths by which patterns in `optimizer.parts` may name the parameter `name`."""
    path = tuple(name.split("."))
    if path[0] == "decoder":
        return [path, ("decoder", "layers", *path[1:]), ("decoder", *path[2:])]
    if path[0] != "refinements":
        return [path]
    below = ("refinement", *path[2:])
    layers = [str(n) for n, at in enumerate(model.refinement_of) if str(at) == path[1]]
    return [path, ("decoder", *below), *(("decoder", "layers", n, *below) for n in layers)]

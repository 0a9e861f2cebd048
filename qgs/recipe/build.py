"""From chosen components to a model, and the learning-rate factors of its parameters."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from qgs.contracts import (
    SUBLAYER_SLOTS,
    Component,
    LayerParts,
    ModelComponent,
    ModelDims,
    Optimizer,
    OptimizerConfig,
    Refinement,
    SceneSource,
)
from qgs.contracts.component import MissingExtraError
from qgs.machine import is_out_of_memory
from qgs.model import QueryGaussianModel
from qgs.recipe.decode import Chosen
from qgs.recipe.errors import Problems, RecipeError, RecipeProblem
from qgs.recipe.places import near_pattern
from qgs.recipe.registry import BUILTIN, component_failure
from qgs.recipe.slots import AFTER_LAYERS
from qgs.recipe.yaml_text import KeyPath, MapNode, find


def build_model(
    parts: Mapping[KeyPath, Chosen],
    dims: ModelDims,
    layer_scale: float,
    seed: int,
    tree: Mapping[str, Any],
    device: torch.device | str | None,
) -> QueryGaussianModel:
    """The model of a checked recipe; on "meta" nothing is allocated.

    Parameters are drawn on the CPU from `seed`, whatever the device; the global random state stays.
    """
    on_meta = device is not None and torch.device(device).type == "meta"
    shared: list[tuple[Chosen, nn.Module]] = []

    def at(*path: str) -> Any:
        chosen = parts["model", *path]
        for known, built in shared:
            if known.component is chosen.component and known.options == chosen.options:
                return built
        built = build(chosen, *(dims,) if issubclass(chosen.component, ModelComponent) else ())
        if issubclass(chosen.component, Refinement) and chosen.component.shared_by_layers:
            shared.append((chosen, built))
        return built

    with (
        torch.random.fork_rng(devices=()),
        torch.device("meta" if on_meta else "cpu"),
        OnMeta() if on_meta else nullcontext(),
    ):
        torch.default_generator.manual_seed(seed)
        # The order is fixed: each component draws its parameters after the one before it.
        encoder, queries = at("encoder"), at("queries")
        decoder, refinements = [], []
        for index in map(str, range(dims.depth)):
            path = ("decoder", "layers", index)
            sublayers = {s: at(*path, s) for s in SUBLAYER_SLOTS if ("model", *path, s) in parts}
            layer = parts["model", *path, "layer"]
            decoder.append(build(layer, LayerParts(dims, sublayers, layer_scale)))
            refinements.append(at(*path, "refinement"))
        model = QueryGaussianModel(
            encoder=encoder,
            queries=queries,
            decoder=decoder,
            refinements=refinements,
            recipe=tree,
            **{name: at(name) for name in AFTER_LAYERS},
        )
    return model if on_meta or device is None else model.to(device)


class OnMeta(TorchFunctionMode):
    """The meta device as constructors need it.

    `linspace` has numbers, which DINO's constructor reads. Weights are not drawn, and `randn` and
    arithmetic give float32 tensors by shape alone: for these torch imports its compiler, 1 to 3 s.
    """

    names = ("add", "sub", "mul", "div", "pow", "__pow__", "__rsub__", "__rdiv__", "__rpow__")
    arithmetic = frozenset(getattr(Tensor, name) for name in names)
    hooked = (nn.init.kaiming_uniform_, nn.init.uniform_, nn.init.normal_)  # mode off inside
    draws = frozenset({*hooked, Tensor.uniform_, Tensor.normal_})

    def __torch_function__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        if func in self.draws and (tensor := args[0] if args else kwargs["tensor"]).is_meta:
            return tensor
        if func is torch.linspace:
            kwargs = {"device": "cpu", **(kwargs or {})}
        elif func is torch.randn and not kwargs:
            func = torch.empty
        elif (func is torch.cat or func in self.arithmetic) and not kwargs:
            tensors = [x for x in (args[0] if func is torch.cat else args) if isinstance(x, Tensor)]
            shapes = [x.shape for x in tensors]
            if all(x.is_meta and x.dtype is torch.float32 for x in tensors):
                if func is not torch.cat:
                    return torch.empty(np.broadcast_shapes(*shapes))
                dim = args[1] % len(shapes[0]) if len(args) > 1 else 0
                length = sum(shape[dim] for shape in shapes)
                return torch.empty(*shapes[0][:dim], length, *shapes[0][dim + 1 :])
        return func(*args, **(kwargs or {}))


def build(chosen: Chosen, *arguments: Any) -> Any:
    """The component itself. arguments: those of its constructor after its Config.

    Raises RecipeError, with the plugin's distribution, where a plugin's constructor fails; a user's
    mistakes pass: missing packages or data, training too short for its optimiser.
    """
    component: Any = chosen.component
    try:
        built = component(chosen.config, *arguments)
    except Exception as error:
        users_mistake = isinstance(error, MissingExtraError) or (
            isinstance(error, ValueError | OSError)
            and issubclass(component, SceneSource | Optimizer)
        )
        if users_mistake or is_out_of_memory(error) or chosen.installed.plugin is BUILTIN:
            raise
        failure = component_failure(chosen.type, "__init__", error, chosen.installed)
        where = chosen.place.origin.file, chosen.place.origin.line
        problem = RecipeProblem(chosen.path, failure.reason, failure.fix, *where)
        raise RecipeError([problem]) from error
    if chosen.schedules:
        built.schedules = chosen.schedules
    return built


def load_pretrained(*parts: nn.Module) -> None:
    """Call `load_pretrained` of every component; its MissingExtraError then names the component."""
    for component in (module for part in parts for module in part.modules()):
        if isinstance(component, Component) and not any(x.is_meta for x in component.parameters()):
            try:
                component.load_pretrained()
            except MissingExtraError as error:
                what = f"{component.slot} `{component.name}`"
                raise MissingExtraError(f"{what} cannot be used: {error}") from error


def rate_factors(module: nn.Module, optimizer: Chosen) -> dict[str, float]:
    """Factor of the learning rate for every parameter of `module`, by name; 1 where none is given.

    module: a model, which leaves patterns of `losses` unchecked, or what holds both. A shared
    parameter goes by its first name. Raises RecipeError.
    """
    config, node, problems = optimizer.config, optimizer.place.node, Problems()
    written = node if isinstance(node, MapNode) else MapNode(optimizer.place.origin)
    model = next(m for m in module.modules() if isinstance(m, QueryGaussianModel))
    factors = {name: 1.0 for name, _ in module.named_parameters()}
    known: dict[int, dict[KeyPath, list[str]]] = {}  # names below a path, by its length
    for name in factors:
        for path in _paths(name.removeprefix("model."), model):
            for end in range(1, len(path) + 1):
                known.setdefault(end, {}).setdefault(path[:end], []).append(name)
    for pattern, factor in config.parts.items() if isinstance(config, OptimizerConfig) else ():
        wanted = pattern.removeprefix("model.").split(".")
        below = known.get(len(wanted), {}).items()
        named = [n for p, names in below if all(map(fnmatchcase, p, wanted)) for n in names]
        factors |= dict.fromkeys(named, factor)
        if not named and (module is not model or wanted[0] != "losses"):
            parts = [path for paths in known.values() for path in paths]
            reason = f"the pattern `{pattern}` matches no parameter of the model"
            outermost = ", ".join(dict.fromkeys(path[0] for path in parts))
            fix = near_pattern(pattern, parts) or f"its parts: {outermost}"
            _, origin, _ = find(written, ("parts", pattern))
            problems.add(origin, f"optimizer.parts.{pattern}", reason, fix)
    problems.raise_any()
    return factors


def _paths(name: str, model: QueryGaussianModel) -> list[KeyPath]:
    """Paths of a parameter: its own, and those under which a recipe has its component."""
    path = tuple(name.split("."))
    if path[0] == "decoder":
        return [path, ("decoder", "layers", *path[1:]), ("decoder", *path[2:])]
    if path[0] != "refinements":
        return [path]
    below = ("refinement", *path[2:])
    layers = [str(n) for n, at in enumerate(model.refinement_of) if str(at) == path[1]]
    return [path, ("decoder", *below), *(("decoder", "layers", n, *below) for n in layers)]

"""From chosen components to a model."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from qgs.composer.decode import Chosen
from qgs.composer.errors import RecipeError, RecipeProblem
from qgs.composer.flow import fits
from qgs.composer.nodes import KeyPath
from qgs.composer.registry import BUILTIN, component_error, component_failure, place_of
from qgs.composer.slots import SUBLAYER_SLOTS
from qgs.contracts import (
    MEMORY_FIELDS,
    Component,
    DecoderLayer,
    LayerParts,
    ModelComponent,
    ModelDims,
    Optimizer,
    Queries,
    Refinement,
    SceneSource,
)
from qgs.contracts.component import MissingExtraError
from qgs.memory import is_out_of_memory
from qgs.model import QueryGaussianModel
from qgs.types import ImageMemory, QueryState


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
        ShapesAlone() if on_meta else nullcontext(),
    ):
        torch.default_generator.manual_seed(seed)
        encoder, queries = at("encoder"), at("queries")
        decoder, refinements = [], []
        for index in map(str, range(dims.depth)):
            path = ("decoder", "layers", index)
            has = [slot for slot in SUBLAYER_SLOTS if ("model", *path, slot) in parts]
            sublayers = {slot: at(*path, slot) for slot in has}
            layer = parts["model", *path, "layer"]
            decoder.append(build(layer, LayerParts(dims, sublayers, layer_scale)))
            refinements.append(at("decoder", "layers", index, "refinement"))
        model = QueryGaussianModel(
            encoder=encoder,
            queries=queries,
            decoder=decoder,
            refinements=refinements,
            recipe=tree,
            **{slot: at(slot) for slot in ("head", "centers", "supervision", "renderer")},
        )
    return model if on_meta or device is None else model.to(device)


class ShapesAlone(TorchFunctionMode):
    """On "meta", makes the results of `randn`, `cat` and arithmetic from their shapes.

    torch's own way to do so (its `broadcast_shapes` too) imports its compiler or sympy, which
    takes longer than everything else that `qgs compose` does. It is left all but plain float32.
    """

    names = ("add", "sub", "mul", "div", "pow", "__pow__", "__rsub__", "__rdiv__", "__rpow__")
    arithmetic = frozenset(getattr(Tensor, name) for name in names)
    plain = (Tensor, "meta", torch.float32, True, False)

    def __torch_function__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        if func is torch.randn and not kwargs:
            func = torch.empty
        elif func is torch.linspace:  # DINO's constructors read its numbers, which meta has not
            kwargs = {"device": "cpu", **(kwargs or {})}
        elif (func is torch.cat or func in self.arithmetic) and len(args) == 2 and not kwargs:
            joined = func is torch.cat
            tensors = args[0] if joined else [x for x in args if type(x) not in (int, float)]
            if isinstance(tensors, list | tuple) and set(map(_kind, tensors)) == {self.plain}:
                shapes = [list(x.shape) for x in tensors]
                with suppress(ValueError, IndexError):  # what does not fit, torch refuses itself
                    shape = _joined(shapes, args[1]) if joined else np.broadcast_shapes(*shapes)
                    return torch.empty(shape, device="meta", dtype=torch.float32)
        return func(*args, **(kwargs or {}))


def _kind(x: Any) -> tuple[Any, ...]:
    plain = isinstance(x, Tensor)
    return (type(x), x.device.type, x.dtype, x.is_contiguous(), x.requires_grad) if plain else ()


def _joined(shapes: Sequence[list[int]], dim: int) -> list[int]:
    length = sum(shape.pop(dim) for shape in shapes)
    if shapes.count(shapes[0]) < len(shapes):
        raise ValueError
    shapes[0].insert(dim % (len(shapes[0]) + 1), length)
    return shapes[0]


def build(chosen: Chosen, *arguments: Any) -> Any:
    """The component itself. arguments: what its constructor takes besides its Config.

    What a plugin's constructor raises is reported with its distribution, except mistakes of the
    user: missing packages, data, training too short for its optimiser.
    """
    component: Any = chosen.component
    try:
        built = component(chosen.config, *arguments)
    except MissingExtraError:
        raise
    except Exception as error:
        if is_out_of_memory(error):  # no fault of the component
            raise
        users_mistake = isinstance(error, ValueError | OSError) and issubclass(
            component, SceneSource | Optimizer
        )
        where = chosen.place.origin.file, chosen.place.origin.line
        if issubclass(component, ModelComponent) and _too_large(error):
            reason = f"`{chosen.type}` with these options has tensors that no machine can hold"
            problem = RecipeProblem(chosen.path, reason, "make the numbers in it smaller", *where)
            raise RecipeError([problem]) from error
        if chosen.installed.plugin is BUILTIN or users_mistake:
            raise
        failure = component_failure(chosen.type, "__init__", error, chosen.installed)
        problem = RecipeProblem(chosen.path, failure.reason, failure.fix, *where)
        raise RecipeError([problem]) from error
    if chosen.schedules:
        built.schedules = chosen.schedules
    if issubclass(component, Queries | Refinement | DecoderLayer):

        def check(module: nn.Module, arguments: tuple[Any, ...], state: Any) -> None:
            if fault := _state_fault(chosen, arguments, state):
                place = place_of(getattr(component, "start", component.forward))
                raise component_error(chosen.installed, f"`{chosen.type}` {fault}", place)
            hook.remove()  # the state is checked until it has once been what it must be

        hook = built.register_forward_hook(check)
    return built


def load_pretrained(*parts: nn.Module) -> None:
    """Call `load_pretrained` of every component; its MissingExtraError then names the component."""
    for component in (module for part in parts for module in part.modules()):
        on_meta = any(x.is_meta for x in component.parameters())
        if isinstance(component, Component) and not on_meta:
            try:
                component.load_pretrained()
            except MissingExtraError as error:
                what = f"{component.slot} `{component.name}`"
                raise MissingExtraError(f"{what} cannot be used: {error}") from error


def _too_large(error: Exception) -> bool:
    """Whether torch or Python refused the size of a tensor; torch has no type for that."""
    words = "Storage size calculation overflowed", "Overflow when unpacking"
    return isinstance(error, OverflowError) or any(word in str(error) for word in words)


def _state_fault(chosen: Chosen, arguments: tuple[Any, ...], state: Any) -> str:
    """What is wrong with a state that a component returned; "" if nothing is.

    A layer returns it with the memory. Neither loses what it was given.
    """
    memory = None
    if issubclass(chosen.component, DecoderLayer):
        pair = state if isinstance(state, tuple) and len(state) == 2 else (state, None)
        state, memory = pair
        if not isinstance(memory, ImageMemory):
            kinds = ", ".join(type(item).__name__ for item in pair if item is not None)
            return f"returns {kinds}, not a QueryState and an ImageMemory"
    if not isinstance(state, QueryState):
        return f"returns {type(state).__name__}, not a QueryState"
    found = ", ".join(state.fields) or "no field at all"
    for name, spec in chosen.component.fields_written(chosen.config).items():
        says = f"says that it provides {name} ({spec}), but"
        if name not in state.fields:
            return f"{says} the state that it returns has {found}"
        shape = tuple(state.fields[name].shape[2:])
        if not fits(shape, spec.shape):
            return f"{says} it returns one of trailing shape {shape}"
    given = {name for argument in arguments for name in getattr(argument, "fields", ())}
    advice = "`state.replace(...)` keeps what it does not change"
    if lost := ", ".join(sorted(given - state.fields.keys())):
        return f"loses {lost}: the state that it returns has {found}; {advice}"
    if state.mask is None and any(getattr(x, "mask", None) is not None for x in arguments):
        return f"loses the mask of the state, so that places without a query count; {advice}"
    parts = [name.removeprefix("memory.") for name in MEMORY_FIELDS]
    before = next((x for x in arguments if memory and isinstance(x, ImageMemory)), None)
    gone = [n for n in parts if getattr(before, n, None) is not None and getattr(memory, n) is None]
    advice = "`dataclasses.replace(memory, features=...)` keeps what it does not change"
    return f"loses {', '.join(gone)} of the image memory; {advice}" if gone else ""

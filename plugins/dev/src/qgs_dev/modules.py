"""Helpers of checks for modules: random seeds, modes, and the values that a module stores."""

import inspect
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy
import torch
from torch import Tensor, nn

# Attributes in which torch stores parameters, buffers, submodules, hooks and the mode.
TORCH_OWN = frozenset(vars(nn.Module()))


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Set torch's random seed inside a `with` block, and restore the random state afterwards."""
    with torch.random.fork_rng(devices=()):
        torch.default_generator.manual_seed(seed)
        yield


def each_mode(module: Any) -> Iterator[str]:
    """Set `module` to evaluation, then to training mode; yield the name of each mode."""
    for mode in ("evaluation", "training"):
        module.train(mode == "training")
        yield mode


def tensors_of(module: nn.Module) -> dict[str, Tensor]:
    """Return all parameters and buffers by name, including buffers that are not saved."""
    return dict(module.named_parameters()) | dict(module.named_buffers())


def attributes(module: nn.Module) -> dict[str, Any]:
    """Return a module's attributes, as copies that can be compared with later ones.

    The result includes attributes of submodules, and of the classes of all these modules. It leaves
    out parameters, buffers, submodules and values of a `cached_property`.
    """
    found = {}
    for name, part in module.named_modules():
        for key, value in vars(part).items():
            # A cached property depends on the module alone.
            kept = isinstance(getattr(type(part), key, None), cached_property)
            if key not in TORCH_OWN and not kept:
                found[f"{name}.{key}".lstrip(".")] = _comparable(value)
        for owner in type(part).__mro__:
            # Classes can have state too, such as a cache that all instances share.
            if owner.__module__.partition(".")[0] in ("torch", "builtins", "abc", "typing"):
                continue
            for key, value in vars(owner).items():
                if not key.startswith(("__", "_abc_")) and not _is_code(value):
                    found[f"{owner.__name__}.{key}"] = _comparable(value)
    return found


def _is_code(value: Any) -> bool:
    """Return True for a function, a class, or a descriptor such as a property."""
    return inspect.isroutine(value) or inspect.isclass(value) or hasattr(value, "__get__")


def _comparable(value: Any, inside: tuple[int, ...] = ()) -> Any:
    """Return a copy of `value` that can be compared with a later copy.

    inside: ids of the containers around `value`. A container inside itself becomes None.
    """
    # A module may hold an object that holds the module.
    if id(value) in inside:
        return None
    inside = (*inside, id(value))
    if isinstance(value, Tensor):
        # Bytes, since a NaN does not equal itself.
        data = value.detach().cpu().contiguous().flatten().view(torch.uint8)
        return str(value.dtype), tuple(value.shape), data.numpy().tobytes()
    if isinstance(value, numpy.ndarray):
        return value.tobytes()
    if isinstance(value, Mapping):
        return {repr(key): _comparable(item, inside) for key, item in value.items()}
    if isinstance(value, list | tuple | deque):
        return [_comparable(item, inside) for item in value]
    if isinstance(value, set | frozenset):
        return sorted(map(repr, value))
    if hasattr(value, "__dict__") and not _is_code(value):
        return type(value), _comparable(vars(value), inside)
    return repr(value)

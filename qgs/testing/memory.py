"""What a module remembers: attributes of its parts and of their classes, made comparable."""

from __future__ import annotations

import inspect
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy
import torch
from torch import Tensor, nn

BOOKKEEPING = frozenset(vars(nn.Module()))
"""Attributes in which torch keeps parameters, buffers, parts, hooks and the mode."""

FOREIGN = ("torch", "builtins", "abc", "typing")
"""Packages whose classes belong to nobody who writes a component."""


def remembered(module: nn.Module) -> dict[str, str | bytes]:
    """Everything but the state dict that a forward pass could leave, by dotted name."""
    found: dict[str, str | bytes] = {}
    for name, part in module.named_modules():
        own = {key: value for key, value in vars(part).items() if key not in BOOKKEEPING}
        found |= _entries(f"{name}." if name else "", own)
        for owner in type(part).__mro__:
            if owner.__module__.partition(".")[0] not in FOREIGN:
                found |= _entries(f"{owner.__name__}.", _data_of(owner))
    return found


def is_torchs_own(part: nn.Module) -> bool:
    """Whether torch defines the class of a module, and not who writes a component."""
    return type(part).__module__.partition(".")[0] == "torch"


def _data_of(owner: type) -> dict[str, Any]:
    """Attributes of a class that are neither methods nor Python's."""
    return {
        key: value
        for key, value in vars(owner).items()
        if not key.startswith(("__", "_abc_")) and not _is_code(value)
    }


def _is_code(value: Any) -> bool:
    """Whether it is a function, a class, or what describes an attribute, and no object called."""
    return inspect.isroutine(value) or inspect.isclass(value) or hasattr(value, "__get__")


def _entries(prefix: str, values: Mapping[str, Any]) -> dict[str, str | bytes]:
    return dict(entry for key, value in values.items() for entry in _told(prefix + key, value, ()))


def _told(name: str, value: Any, inside: tuple[int, ...]) -> Iterator[tuple[str, str | bytes]]:
    """The entries of one value; `inside` holds what contains it, so that circles end."""
    if id(value) in inside:
        return
    inside = (*inside, id(value))
    if isinstance(value, Tensor):
        yield name, _bits(value)
    elif isinstance(value, numpy.ndarray):
        yield name, value.tobytes()
    elif isinstance(value, Mapping):
        yield name, f"{len(value)} entries"
        for key, item in value.items():
            yield from _told(f"{name}[{key!r}]", item, inside)
    elif isinstance(value, list | tuple | deque):
        yield name, f"{len(value)} items"
        for index, item in enumerate(value):
            yield from _told(f"{name}[{index}]", item, inside)
    elif isinstance(value, set | frozenset):
        yield name, str(sorted(map(repr, value)))
    elif hasattr(value, "__dict__") and not _is_code(value):
        yield name, type(value).__name__
        for key, item in vars(value).items():
            yield from _told(f"{name}.{key}", item, inside)
    else:
        yield name, repr(value)


def _bits(tensor: Tensor) -> bytes | str:
    if tensor.device.type == "meta":
        return str(tensor.shape)
    flat = tensor.detach().cpu().contiguous().flatten()
    return (
        f"{tensor.dtype} {tuple(tensor.shape)} ".encode() + flat.view(torch.uint8).numpy().tobytes()
    )

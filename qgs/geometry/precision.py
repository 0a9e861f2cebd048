"""Geometry keeps its precision whatever the autocast setting of the caller."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import fields, replace
from functools import wraps
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from qgs.types import _TensorContainer as TensorContainer

F = TypeVar("F", bound=Callable[..., Any])

HALF = (torch.float16, torch.bfloat16)
HOLDERS = (TensorContainer, Mapping, list, tuple)


def at_least_float32(x: Tensor) -> Tensor:
    """Half-precision tensors raised to float32, others as they are."""
    return x.float() if x.dtype in HALF else x


def full_precision(function: F) -> F:
    """Run `function` outside autocast, with half-precision tensor arguments raised to float32.

    Tensors are found as arguments, and in lists, tuples, mappings and the containers of
    `qgs.types`; what holds no half-precision tensor is handed on itself. A raised ImageMemory is a
    copy, whose `once` starts anew. float64 stays float64, so that gradient checks work.
    """

    @wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        device = _device_of((*args, *kwargs.values())) or _device_without_tensors()
        # Leaving the outermost autocast of a thread empties a cache that all threads share, so
        # a thread that loads data must not enter one while another trains.
        inside = device != "meta" and torch.is_autocast_enabled(device)
        with torch.autocast(device_type=device, enabled=False) if inside else nullcontext():
            return function(*map(_raised, args), **{k: _raised(v) for k, v in kwargs.items()})

    return cast(F, wrapper)


def _device_of(values: Iterable[Any]) -> str | None:
    """Type of the device of the first tensor in `values`, those in the open before nested ones."""
    nested = []
    for value in values:
        if isinstance(value, Tensor):
            return value.device.type
        if isinstance(value, HOLDERS):
            nested.append(value)
    for value in nested:
        device = _device_of(_items(value).values())
        if device is not None:
            return device
    return None


def _device_without_tensors() -> str:
    return "cuda" if torch.is_autocast_enabled("cuda") else "cpu"


def _raised(value: Any) -> Any:
    if isinstance(value, Tensor):
        return at_least_float32(value)
    if not isinstance(value, HOLDERS):
        return value
    items = _items(value)
    raised = {key: _raised(item) for key, item in items.items()}
    if all(raised[key] is item for key, item in items.items()):
        return value
    if isinstance(value, TensorContainer):
        return replace(cast(Any, value), **raised)
    if isinstance(value, Mapping):
        return raised
    return getattr(value, "_make", type(value))(list(raised.values()))


def _items(value: Any) -> Mapping[Any, Any]:
    if isinstance(value, TensorContainer):
        return {f.name: getattr(value, f.name) for f in fields(cast(Any, value)) if f.init}
    return value if isinstance(value, Mapping) else dict(enumerate(value))

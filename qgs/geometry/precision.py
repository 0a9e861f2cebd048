"""Geometry keeps its precision whatever the autocast setting of the caller."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from functools import wraps
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

F = TypeVar("F", bound=Callable[..., Any])


def at_least_float32(x: Tensor) -> Tensor:
    """Half-precision tensors raised to float32, others as they are."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x


def full_precision(function: F) -> F:
    """Run `function` outside autocast, with half-precision tensor arguments raised to float32.

    float64 arguments stay float64, so that gradient checks work.
    """

    def raised(value: Any) -> Any:
        return at_least_float32(value) if isinstance(value, Tensor) else value

    @wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        tensors = [v for v in (*args, *kwargs.values()) if isinstance(v, Tensor)]
        device = tensors[0].device.type if tensors else "cpu"
        # Leaving the outermost autocast of a thread empties a cache that all threads share, so
        # a thread that loads data must not enter one while another trains.
        inside = device != "meta" and torch.is_autocast_enabled(device)
        with torch.autocast(device_type=device, enabled=False) if inside else nullcontext():
            return function(*map(raised, args), **{k: raised(v) for k, v in kwargs.items()})

    return cast(F, wrapper)

"""Precision of a model's computation: autocast, and at least float32 for functions on geometry."""

from collections.abc import Callable
from contextlib import nullcontext
from functools import wraps
from typing import Any, Literal, TypeVar, cast

import torch
from torch import Tensor

from qgs.containers import map_tensors, named_tensors

F = TypeVar("F", bound=Callable[..., Any])

Precision = Literal["float32", "bf16"]
"""Precisions for `training.precision` and `qgs bench`. Weights are float32 in both."""


def autocast(precision: Precision, device: str) -> torch.autocast:
    """Return the context in which a model computes in `precision`.

    Functions decorated with `full_precision`, such as those on geometry, stay in float32. bfloat16
    has the same exponents as float32, so gradients need no scaling.
    """
    return torch.autocast(device, torch.bfloat16, enabled=precision == "bf16")


def at_least_float32(x: Tensor) -> Tensor:
    """Return `x` in float32 if it is in half precision; otherwise return `x` itself."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x


def full_precision(function: F) -> F:
    """Decorate `function` to run outside autocast, with half-precision arguments cast to float32.

    Tensors inside containers, mappings, lists and tuples are cast too. Arguments without a
    half-precision tensor are passed on unchanged. An ImageMemory that is cast becomes a copy
    without the tensors that `once` cached. float64 stays float64, so that gradient checks work.
    """

    @wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        device = "cuda" if torch.is_autocast_enabled("cuda") else "cpu"
        if first := next(named_tensors([args, kwargs]), None):
            device = first[1].device.type
        # Leaving the outermost autocast of a thread empties a cache that all threads share.
        # Therefore a thread that loads data must not enter one while another thread trains.
        inside = device != "meta" and torch.is_autocast_enabled(device)
        with torch.autocast(device_type=device, enabled=False) if inside else nullcontext():
            return function(
                *map_tensors(at_least_float32, args), **map_tensors(at_least_float32, kwargs)
            )

    return cast(F, wrapper)

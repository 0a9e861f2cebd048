"""How the kernels of `qgs/cpu` are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

_OPTIONS = {
    "nogil": True,
    "error_model": "numpy",  # no branch on a division by zero
    "fastmath": {"contract", "reassoc", "arcp", "nsz"},
}


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` on first use, kept on disk where there is a place that can be written."""
    try:
        return njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # numba found none
        return njit(**_OPTIONS)(function)

"""Compiling functions with numba (the extra `cpu`, see `qgs.threads.can_compile`)."""

from collections.abc import Callable
from typing import Any

from numba import njit


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` on first use, kept on disk where there is a place that can be written."""
    options = {
        "nogil": True,
        "error_model": "numpy",  # no branch on a division by zero
        "fastmath": {"contract", "reassoc", "arcp", "nsz"},
        # kernels from the cache share what they call, and may run another's build of it
        "forceinline": True,
    }
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no such place
        return njit(**options)(function)

"""Compiled loops of the renderer `qgs/cpu`, by numba.

Nothing here is needed to understand a model. Each kernel computes what a few lines of torch say
elsewhere, which are its oracle in the tests, without tensors of all pairs.
"""

from collections.abc import Callable
from typing import Any


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` with numba on first use, kept on disk where a place can be written."""
    from numba import njit

    options = {
        "nogil": True,
        # No branch on a division by zero.
        "error_model": "numpy",
        "fastmath": {"contract", "reassoc", "arcp", "nsz"},
        # kernels from the cache share what they call, and may run another's build of it
        "forceinline": True,
    }
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:
        # Numba found no such place.
        return njit(**options)(function)

"""Loops compiled by numba, for the renderer `qgs/cpu` and SSIM.

Kernels only save time and memory: each kernel computes the same as a few lines of torch in another
module, but without tensors over all pairs of Gaussian and pixel. Tests compare both versions.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

# In float32: with plain numbers, kernels would compute in float64.
ZERO = np.float32(0)
HALF = np.float32(0.5)
ONE = np.float32(1)
TWO = np.float32(2)
LOG2_E = np.float32(1.4426950408889634)


def kernel(function: Callable[..., Any], **more: Any) -> Any:
    """Compile `function` with numba on first use; cache the result on disk if possible.

    more: options of `numba.njit` that extend or replace the project's options.
    """
    from numba import njit

    options = {
        "nogil": True,
        # No branch on a division by zero.
        "error_model": "numpy",
        "fastmath": {"contract", "reassoc", "arcp", "nsz"},
        # Cached kernels share the functions that they call by name, so one loaded from the cache
        # may run another kernel's build of them, with other roundings; what is inlined is its own.
        "forceinline": True,
        **more,
    }
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:
        # Numba found no such place.
        return njit(**options)(function)

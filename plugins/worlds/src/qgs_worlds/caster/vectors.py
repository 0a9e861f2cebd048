"""Options for compiling kernels, and operations on points, directions and colours.

These are tuples of three numbers, or anything that is indexed in the same way.
"""

import math
from typing import Any

import numpy as np
from numba import njit

OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "arcp", "nsz"},
    # Cached kernels share the functions that they call by name, so one loaded from the cache
    # may run another kernel's build of them, with other roundings; what is inlined is its own.
    "forceinline": True,
}
"""Options for functions that Python calls or that allocate arrays."""

INNER: dict[str, Any] = {
    **OPTIONS,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    # Counting references to the passed arrays takes longer than the work on them.
    "_nrt": False,
}
"""Options for functions that only kernels call and that allocate no arrays."""

REDUCING: dict[str, Any] = {**INNER, "fastmath": {"contract", "reassoc", "arcp", "nsz", "nnan"}}
"""Options for minima over a loop, which LLVM vectorises if no number is NaN."""


@njit(**INNER)
def triple(a):
    """Return the three numbers of an array as a tuple."""
    return a[0], a[1], a[2]


@njit(**INNER)
def narrow(a):
    """Return the three numbers in float32."""
    return np.float32(a[0]), np.float32(a[1]), np.float32(a[2])


@njit(**INNER)
def dot(a, b):
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(**INNER)
def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(**INNER)
def along(o, t, d):
    """Return o + t d."""
    return o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]


@njit(**INNER)
def times(s, a):
    """Return s a."""
    return s * a[0], s * a[1], s * a[2]


@njit(**INNER)
def over(a, s):
    """Return a / s."""
    return a[0] / s, a[1] / s, a[2] / s


@njit(**INNER)
def product(a, b):
    """Return the product of each pair of numbers, for example of a colour and the light on it."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@njit(**INNER)
def mix(a, b, w):
    """Return a + w (b - a)."""
    return a[0] + w * (b[0] - a[0]), a[1] + w * (b[1] - a[1]), a[2] + w * (b[2] - a[2])


@njit(**INNER)
def unit(a):
    """Return the direction of a vector."""
    # the summand keeps a vector without length from becoming NaN
    return times(1.0 / math.sqrt(dot(a, a) + 1e-20), a)


@njit(**INNER)
def longest(a):
    """Return the axis along which a vector is longest."""
    if abs(a[0]) >= abs(a[1]) and abs(a[0]) >= abs(a[2]):
        return 0
    return 1 if abs(a[1]) >= abs(a[2]) else 2

"""Decorators that compile kernels with numba, and operations on points, directions and colours.

These are tuples of three numbers, or anything that is indexed in the same way.
"""

import math
from functools import partial

import numpy as np

from qgs.kernels import kernel

inner = partial(
    kernel,
    no_cpython_wrapper=True,
    no_cfunc_wrapper=True,
    # Counting references to the passed arrays takes longer than the work on them.
    _nrt=False,
)
"""Decorator of functions that only kernels call and that allocate no arrays; see `kernel`."""

reducing = partial(inner, fastmath={"contract", "reassoc", "arcp", "nsz", "nnan"})
"""Decorator of minima over a loop, which LLVM vectorises if no number is NaN."""


@inner
def triple(a):
    """Return the three numbers of an array as a tuple."""
    return a[0], a[1], a[2]


@inner
def narrow(a):
    """Return the three numbers in float32."""
    return np.float32(a[0]), np.float32(a[1]), np.float32(a[2])


@inner
def dot(a, b):
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inner
def along(o, t, d):
    """Return o + t d."""
    return o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]


@inner
def times(s, a):
    """Return s a."""
    return s * a[0], s * a[1], s * a[2]


@inner
def over(a, s):
    """Return a / s."""
    return a[0] / s, a[1] / s, a[2] / s


@inner
def product(a, b):
    """Return the product of each pair of numbers, for example of a colour and the light on it."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@inner
def mix(a, b, w):
    """Return a + w (b - a)."""
    return a[0] + w * (b[0] - a[0]), a[1] + w * (b[1] - a[1]), a[2] + w * (b[2] - a[2])


@inner
def unit(a):
    """Return the direction of a vector."""
    # the summand keeps a vector without length from becoming NaN
    return times(1.0 / math.sqrt(dot(a, a) + 1e-20), a)


@inner
def longest(a):
    """Return the axis along which a vector is longest."""
    if abs(a[0]) >= abs(a[1]) and abs(a[0]) >= abs(a[2]):
        return 0
    return 1 if abs(a[1]) >= abs(a[2]) else 2

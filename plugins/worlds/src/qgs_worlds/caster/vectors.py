"""Decorators for numba kernels, and operations on points, directions and RGB colours.

Points, directions and colours are tuples or arrays of three numbers.
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
"""Decorator like `kernel`, for functions that only kernels call and that allocate no arrays."""

reducing = partial(inner, fastmath={"contract", "reassoc", "arcp", "nsz", "nnan"})
"""Decorator `inner` with fast arithmetic, for loops that take a minimum of values without NaN."""


@inner
def triple(a):
    """Return an array a of three numbers as a tuple."""
    return a[0], a[1], a[2]


@inner
def narrow(a):
    """Return the vector a as a tuple of float32 numbers."""
    return np.float32(a[0]), np.float32(a[1]), np.float32(a[2])


@inner
def dot(a, b):
    """Return the dot product of a and b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def minus(a, b):
    """Return the vector a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inner
def along(o, t, d):
    """Return o + t * d: the point at parameter t of the ray from o in direction d."""
    return o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]


@inner
def times(s, a):
    """Return the vector a times the number s."""
    return s * a[0], s * a[1], s * a[2]


@inner
def over(a, s):
    """Return the vector a divided by the number s."""
    return a[0] / s, a[1] / s, a[2] / s


@inner
def product(a, b):
    """Return the elementwise product of a and b, for example of a colour and the light on it."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@inner
def mix(a, b, w):
    """Return a + w * (b - a), the linear interpolation from a to b."""
    return along(a, w, minus(b, a))


@inner
def unit(a):
    """Return the vector a divided by its length; a zero vector gives a zero vector."""
    # the summand keeps a vector without length from becoming NaN
    return times(1.0 / math.sqrt(dot(a, a) + 1e-20), a)


@inner
def longest(a):
    """Return the number of the axis, 0 to 2, on which a vector has the largest absolute value."""
    if abs(a[0]) >= abs(a[1]) and abs(a[0]) >= abs(a[2]):
        return 0
    return 1 if abs(a[1]) >= abs(a[2]) else 2

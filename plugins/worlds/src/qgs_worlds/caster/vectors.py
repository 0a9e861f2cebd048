"""Points, directions and colours in kernels: tuples of three numbers, or anything indexed alike."""

import math

from numba import njit

from qgs_worlds.caster.kernels import INNER


@njit(**INNER)
def triple(a):
    """Return the three numbers of an array as a tuple."""
    return a[0], a[1], a[2]


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
    """Return the product of each pair of numbers, as of a colour and the light on it."""
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

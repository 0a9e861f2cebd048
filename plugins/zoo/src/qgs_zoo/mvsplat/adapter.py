"""Conversion of colours and rotations from the pixelSplat family of models to qgs.

These models predict spherical harmonics in e3nn's basis and rotations in the camera's frame.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.constants import constant
from qgs.geometry.harmonics import rotated
from qgs.precision import full_precision

SH_DEGREE = 3
"""Largest degree of harmonics that the rasterisers of the released code and of qgs render."""
QUAT_EPS = 1e-8


def coefficients(degree: int) -> int:
    """Return the number of spherical harmonics of degrees 0 to `degree`."""
    return (degree + 1) ** 2


def e3nn_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Return real spherical harmonics (..., K) of degrees 0 to `degree` at unit vectors (..., 3).

    The functions of each degree l are in e3nn's order: m from -l to l, with y as the polar axis and
    azimuth from z to x. So degree 1 is (x, y, z). All functions are orthonormal up to one common
    factor. K: number of functions.
    """
    x, y, z = directions.unbind(-1)
    # cos and i sin of m times the azimuth, times sin^m of the angle to the pole, by angle addition:
    # no angle is computed.
    step = torch.complex(z, x)
    power = torch.ones_like(step)
    found: dict[tuple[int, int], Tensor] = {}
    for m in range(degree + 1):
        # Associated Legendre functions divided by sin^m, by their recurrence in l.
        legendre = [torch.zeros_like(y), torch.full_like(y, math.prod(range(1, 2 * m, 2)))]
        for n in range(m, degree + 1):
            ratio = math.factorial(n - m) / math.factorial(n + m)
            scale = math.sqrt((2 * n + 1) * ratio * (2 if m else 1))
            values = scale * legendre[-1] * power
            # For m = 0 both are one function, the real part.
            found[n, -m] = values.imag
            found[n, m] = values.real
            following = (2 * n + 1) * y * legendre[-1] - (n + m) * legendre[-2]
            legendre.append(following / (n - m + 1))
        power = power * step
    return torch.stack([found[place] for place in sorted(found)], -1)


def _fitted(degree: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return 64 directions, the pseudo-inverse of their e3nn harmonics, and a change of basis.

    The change of basis is a matrix from coefficients in e3nn's basis to coefficients in qgs's.
    """
    generator = torch.Generator().manual_seed(0)
    double = {"dtype": torch.float64, "device": "cpu"}
    # more directions than the 25 harmonics of degree 4, so that the fit is exact
    around = F.normalize(torch.randn(64, 3, generator=generator, **double), dim=-1)
    # The rasteriser of the family evaluates the functions of 3DGS at (z, x, y) of a direction.
    cycle = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], **double)
    count = coefficients(min(degree, SH_DEGREE))
    change = torch.eye(coefficients(degree), **double)
    change[1:count, 1:count] = rotated(torch.eye(count - 1, **double), cycle)
    return around, torch.linalg.pinv(e3nn_harmonics(around, degree)), change


# Computed at import. The first pass may run on shapes only (the FLOPs of `qgs bench`) or in
# inference mode, and later passes must not get its tensors.
with torch.inference_mode(False):
    _FITTED = {degree: _fitted(degree) for degree in (1, 2, 3, 4)}


@full_precision
def turn_of_harmonics(rotation: Tensor, degree: int) -> Tensor:
    """Return Wigner matrices (..., K, K) of rotations (..., 3, 3) for K harmonics of e3nn.

    The matrices map the coefficients of a function on the sphere to the coefficients of the rotated
    function. They are an exact fit, in float64, to values in 64 directions. The released code uses
    Euler angles, which lose digits for small tilts.
    """
    # Small copies, for which the CPU does not wait. Kept ones could be those of another mode.
    directions, inverse = (x.to(rotation.device, non_blocking=True) for x in _FITTED[degree][:2])
    turned = torch.einsum("...ij,sj->...si", rotation.double(), directions)
    # Y(R d) = D Y(d) for every direction d.
    return (inverse @ e3nn_harmonics(turned, degree)).mT.to(rotation.dtype)


def band_mask(degree: int, like: Tensor) -> Tensor:
    """Return the factors (K,) by which pixelSplat multiplies raw coefficients of harmonics.

    The factors are 1 for degree 0, and 0.1 / 4^l for each higher degree l. like: tensor whose dtype
    and device the factors get.
    """
    # Higher degrees start small (pixelSplat): at first colours hardly depend on the direction.
    each = [0.1 * 0.25**n if n else 1.0 for n in range(degree + 1) for _ in range(2 * n + 1)]
    return constant(each, like)


@full_precision
def world_harmonics(rotation: Tensor, degree: int) -> Tensor:
    """Return matrices (..., K, K) from raw to world-frame coefficients of K harmonics.

    Raw coefficients are in a camera's frame. rotation: camera to world (..., 3, 3). A matrix first
    rotates in e3nn's basis, then changes the basis; degrees above SH_DEGREE stay in e3nn's basis.
    The order matters, because pixelSplat's rasteriser uses different signs than e3nn. Published
    weights were trained with this order and with `views.frame: given`, so they need both.
    """
    turn = turn_of_harmonics(rotation, degree) * band_mask(degree, rotation)
    return _FITTED[degree][2].to(rotation, non_blocking=True) @ turn


def camera_quaternions(raw_xyzw: Tensor) -> Tensor:
    """Normalise raw quaternions (..., 4), x y z w. A quaternion of zeros stays zero."""
    return raw_xyzw / (raw_xyzw.norm(dim=-1, keepdim=True) + QUAT_EPS)

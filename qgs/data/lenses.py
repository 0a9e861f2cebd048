"""Lenses that bend rays: where a direction lands that a pinhole would have put elsewhere."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import TypeAlias

import torch
from torch import Tensor


@dataclass(frozen=True)
class RadialTangential:
    """OpenCV's plumb-bob model (Brown, 1966), also COLMAP's SIMPLE_RADIAL, RADIAL and OPENCV."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def distorted(self, points: Tensor) -> Tensor:
        """Where the lens puts points (..., 2) of the plane z = 1."""
        x, y = points.unbind(-1)
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return torch.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            -1,
        )


@dataclass(frozen=True)
class Fisheye:
    """OpenCV's fisheye model (Kannala and Brandt, 2006), COLMAP's OPENCV_FISHEYE.

    Without coefficients it is the equidistant fisheye, which still bends rays.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def distorted(self, points: Tensor) -> Tensor:
        """Where the lens puts points (..., 2) of the plane z = 1."""
        radius = points.norm(dim=-1, keepdim=True)
        theta = radius.atan()
        t2 = theta * theta
        bent = theta * (1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))
        return points * torch.where(radius > 0, bent / radius, 1.0)


Lens: TypeAlias = RadialTangential | Fisheye


def bending(lens: Lens) -> Lens | None:
    """`lens`, or None where it leaves every ray as a pinhole would."""
    return lens if isinstance(lens, Fisheye) or any(astuple(lens)) else None

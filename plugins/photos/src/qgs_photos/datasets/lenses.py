"""Model the distortion of lenses, and undistort photos."""

import math
from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.data.photos.reader import Intrinsics, Lens, Size

MOST_ZOOM = 2.0
# Rows that are undistorted at once: photos of phones would take gigabytes.
_ROWS = 64


class BendingLens(Lens):
    """A lens with distortion: a map of the plane z = 1 in front of the camera.

    It maps the point in which a pinhole camera sees a ray to the point in which this lens sees it.
    """

    @abstractmethod
    def distorted(self, points: Tensor) -> Tensor:
        """Map undistorted points (..., 2) in the plane z = 1 to distorted ones."""

    @abstractmethod
    def sees(self, points: Tensor) -> Tensor:
        """Return whether undistorted points (..., 2) are in the photo's valid range.

        Beyond it, the distorted radius decreases, and the map would show the photo again.
        """

    def undistorted(
        self, pixels: np.ndarray, intrinsics: Intrinsics, nearest: bool = False
    ) -> np.ndarray:
        """See `Lens`."""
        height, width = pixels.shape[:2]
        focal, centre = torch.tensor(intrinsics).split(2)
        x = (torch.arange(width) + 0.5 - centre[0]) / focal[0]
        y = (torch.arange(height)[:, None] + 0.5 - centre[1]) / focal[1]
        planes = torch.from_numpy(pixels.reshape(height, width, -1)).permute(2, 0, 1).float()
        mode = "nearest" if nearest else "bilinear"
        result = np.empty_like(pixels)
        for top in range(0, height, _ROWS):
            block = slice(top, top + _ROWS)
            directions = torch.stack(torch.broadcast_tensors(x, y[block]), -1)
            grid, seen = _in_photo(directions, intrinsics, self, (height, width))
            flat = F.grid_sample(
                planes[None], grid[None], mode=mode, padding_mode="border", align_corners=False
            )[0]
            part = (flat * seen).permute(1, 2, 0).numpy().reshape(result[block].shape)
            result[block] = part.round() if pixels.dtype.kind in "iu" else part
        return result

    def whole_zoom(self, intrinsics: Intrinsics, size: Size, target: Size) -> float:
        """See `Lens`. Same choice as the default of COLMAP's undistorter (blank_pixels 0).

        Returns 1 if black pixels remain even at MOST_ZOOM.
        """
        return _whole_zoom(intrinsics, self, size, target)


@dataclass(frozen=True)
class RadialTangential(BendingLens):
    """OpenCV's radial-tangential distortion (Brown, 1966).

    Covers COLMAP's camera models SIMPLE_RADIAL, RADIAL and OPENCV.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def distorted(self, points: Tensor) -> Tensor:
        """See `BendingLens`."""
        # kornia's distort_points takes half as long again, and this is most of undistorting.
        x, y = points.unbind(-1)
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        u = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        v = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return torch.stack([u, v], -1)

    def sees(self, points: Tensor) -> Tensor:
        """Return whether points (..., 2) lie where the radial polynomial still grows."""
        return (points * points).sum(-1) < _turn(self.k1, self.k2, self.k3)

    def turned(self) -> Self:
        """See `Lens`."""
        # (p2, p1) is a vector in the image.
        return replace(self, p1=self.p2, p2=-self.p1)


@dataclass(frozen=True)
class Fisheye(BendingLens):
    """OpenCV's fisheye distortion (Kannala and Brandt, 2006); equidistant if all are 0."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def distorted(self, points: Tensor) -> Tensor:
        """See `BendingLens`."""
        radius = points.norm(dim=-1, keepdim=True)
        theta = radius.atan()
        t2 = theta * theta
        bent = theta * (1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))
        return points * torch.where(radius > 0, bent / radius, 1.0)

    def sees(self, points: Tensor) -> Tensor:
        """Return whether points (..., 2) lie where the polynomial in the angle still grows."""
        return points.norm(dim=-1).atan().square() < _turn(self.k1, self.k2, self.k3, self.k4)

    def turned(self) -> Self:
        """See `Lens`. The distortion has rotational symmetry, so the lens does not change."""
        return self


def bending(lens: BendingLens) -> BendingLens | None:
    """Return `lens`, or None if it has no distortion."""
    return lens if isinstance(lens, Fisheye) or any(vars(lens).values()) else None


def _turn(*coefficients: float) -> float:
    """Return r^2 for the least radius r at which r (1 + k1 r^2 + k2 r^4 + ...) stops growing.

    coefficients: k1, k2, ... Returns infinity if it always grows. Beyond this radius the polynomial
    would show the photo again, mirrored.
    """
    slope = [1.0, *((2 * i + 3) * k for i, k in enumerate(coefficients))]
    # Numerical roots of a real polynomial have small imaginary parts.
    roots = np.roots(slope[::-1])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(real.min()) if len(real) else math.inf


def _in_photo(
    directions: Tensor, intrinsics: Intrinsics, lens: BendingLens, size: Size
) -> tuple[Tensor, Tensor]:
    """Return the places of directions (..., 2) in the photo, and whether the photo shows them.

    directions: undistorted, in the plane z = 1. Places (..., 2) go from -1 to 1 across the photo.
    """
    focal, centre = torch.tensor(intrinsics).to(directions).split(2)
    # From the pinhole's pixel to the photo's: the distortion is given in this direction.
    source = focal * lens.distorted(directions) + centre
    grid = source / source.new_tensor(size[::-1]) * 2 - 1
    return grid, lens.sees(directions) & (grid.abs() <= 1).all(-1)


@lru_cache(maxsize=4096)
def _whole_zoom(intrinsics: Intrinsics, lens: BendingLens, size: Size, target: Size) -> float:
    side = torch.linspace(-1, 1, 65).double()
    ends = torch.ones_like(side)
    edges = [(side, ends), (side, -ends), (ends, side), (-ends, side)]
    border = torch.cat([torch.stack(edge, -1) for edge in edges])
    middle = torch.tensor(size[::-1]).double() / 2
    half = torch.tensor(target[::-1]).double() / 2
    reach = max(target[0] / size[0], target[1] / size[1])
    focal, centre = torch.tensor(intrinsics).double().split(2)

    def whole(zoom: float) -> bool:
        # Resampling reads a pixel beyond the crop.
        points = middle + border * (half / reach / zoom + (zoom > 1))
        return bool(_in_photo((points - centre) / focal, intrinsics, lens, size)[1].all())

    if whole(1.0) or not whole(MOST_ZOOM):
        return 1.0
    low = 1.0
    high = MOST_ZOOM
    for _ in range(16):
        mean = (low + high) / 2
        if whole(mean):
            high = mean
        else:
            low = mean
    return high

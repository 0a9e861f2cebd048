"""Model the distortion of lenses, and undistort photos."""

import importlib
import math
import signal
from bisect import bisect_left
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any, Self

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.data.photos.nerfstudio import PINHOLE
from qgs.data.photos.reader import Intrinsics, Lens, Size

FOCAL = ("f", "fx", "fy")
"""Names of focal lengths among the parameters of COLMAP's camera models."""
MOST_ZOOM = 2.0
# Rows that are undistorted at once: photos of phones would take gigabytes.
_ROWS = 64


@dataclass(frozen=True)
class BendingLens(Lens):
    """Lens with the distortion of any of COLMAP's camera models, computed by pycolmap.

    model: COLMAP's name of the camera model; OpenCV's models are among them. parameters: in
    COLMAP's order, with focal lengths of 1 and the principal point at 0, for the camera before it
    was turned. turns: number of clockwise quarter turns of the camera.
    """

    model: str
    parameters: tuple[float, ...]
    turns: int = 0

    def distorted(self, points: Tensor) -> Tensor:
        """Distort points (..., 2) of the plane z = 1, before focal lengths are applied."""
        camera = _pycolmap().Camera(model=self.model, width=1, height=1, params=self.parameters)
        # a quarter clockwise makes (-y, x) of (x, y)
        plane = torch.view_as_complex(points.double().contiguous()).numpy() * (-1j) ** self.turns
        flat = plane.ravel()
        bent = camera.img_from_cam(np.c_[flat.real, flat.imag, np.ones(len(flat))])
        turned = (bent @ [1, 1j]).reshape(plane.shape) * 1j**self.turns
        return torch.view_as_real(torch.from_numpy(turned)).to(points)

    def turned(self) -> Self:
        """Return the lens of this camera after a clockwise turn by 90 degrees."""
        return replace(self, turns=self.turns + 1)

    def undistorted(
        self, pixels: np.ndarray, intrinsics: Intrinsics, nearest: bool = False
    ) -> np.ndarray:
        """Return the photo that a pinhole camera with the same intrinsics would have taken.

        pixels: the photo, (H, W) or (H, W, C); the result has the same shape and dtype, with 0
        outside of the photo. intrinsics: fx, fy, cx, cy in pixels of the photo. nearest: take the
        nearest pixel instead of interpolating.
        """
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

    @lru_cache(maxsize=4096)  # noqa: B019  # lenses are few, and equal ones are one
    def whole_zoom(self, intrinsics: Intrinsics, size: Size, target: Size) -> float:
        """Return the smallest zoom of a centre crop without black pixels in an undistorted photo.

        COLMAP's undistorter makes the same choice by default (blank_pixels 0). intrinsics: fx, fy,
        cx, cy in pixels of the photo. size: (H, W) of the photo. target: (H, W) whose aspect ratio
        the crop has. Returns 1 if black pixels remain even at MOST_ZOOM.
        """
        side = torch.linspace(-1, 1, 65).double()
        square = torch.cartesian_prod(side, side)
        border = square[square.abs().amax(-1) == 1]
        middle = torch.tensor(size[::-1]).double() / 2
        half = torch.tensor(target[::-1]).double() / 2
        reach = max(target[0] / size[0], target[1] / size[1])
        focal, centre = torch.tensor(intrinsics).double().split(2)

        def whole(zoom: float) -> bool:
            # Resampling reads a pixel beyond the crop.
            points = middle + border * (half / reach / zoom + (zoom > 1))
            return bool(_in_photo((points - centre) / focal, intrinsics, self, size)[1].all())

        if whole(1.0) or not whole(MOST_ZOOM):
            return 1.0
        zooms = np.linspace(1, MOST_ZOOM, 2**16 + 1)
        return float(zooms[bisect_left(zooms, True, hi=2**16, key=whole)])


def bending(model: str, coefficients: Mapping[str, float]) -> BendingLens | None:
    """Return the lens of COLMAP's camera model `model`; None if the camera is a pinhole.

    coefficients: distortion coefficients by COLMAP's names; those not given are 0. Raises
    ValueError for a panorama or an unknown model.
    """
    names = parameters(model)
    if model in PINHOLE and not any(coefficients.values()):
        return None
    if "cx" not in names:
        raise ValueError(
            f"the camera model {model} is a panorama, which has no lens: use perspective or "
            "fisheye photos"
        )
    ideal = dict.fromkeys(FOCAL, 1.0) | dict(coefficients)
    return BendingLens(model, tuple(ideal.get(name, 0.0) for name in names))


def parameters(model: str) -> list[str]:
    """Return the names of a camera model's parameters. Raises ValueError for an unknown model."""
    try:
        return _pycolmap().Camera(model=model).params_info.split(", ")
    except RuntimeError as error:
        raise ValueError(f"the camera model {model} is not one of COLMAP's") from error


def model_name(number: int) -> str:
    """Return the name of the camera model that has this number in binary files of COLMAP."""
    return _pycolmap().CameraModelId(number).name


@cache
def _pycolmap() -> Any:
    # it takes a while to load, and most photos are of pinholes
    handler = signal.getsignal(signal.SIGTERM)
    module = importlib.import_module("pycolmap")
    # its own prints a trace, and ends a training that would be kept; threads cannot set one
    with suppress(ValueError):
        signal.signal(signal.SIGTERM, handler)
    return module


@lru_cache(maxsize=4096)
def _reach(lens: BendingLens) -> float:
    """Return the radius, in the plane z = 1, up to which distorted radii of `lens` increase.

    Points beyond this radius would appear a second time, mirrored. inf if distorted radii increase
    up to 84 degrees from the axis.
    """
    radii = torch.linspace(0, 10, 20_001).double()
    rising = lens.distorted(torch.stack([radii, torch.zeros_like(radii)], -1))[:, 0].diff() > 0
    return math.inf if rising.all() else float(radii[rising.logical_not().nonzero()[0, 0]])


def _in_photo(
    directions: Tensor, intrinsics: Intrinsics, lens: BendingLens, size: Size
) -> tuple[Tensor, Tensor]:
    """Return where directions (..., 2) appear in the photo, and whether the photo shows them.

    directions: undistorted points of the plane z = 1. Results: coordinates (..., 2) from -1 to 1
    across the photo, and booleans (...).
    """
    focal, centre = torch.tensor(intrinsics).to(directions).split(2)
    # From the pinhole's pixel to the photo's: the distortion is given in this direction.
    source = focal * lens.distorted(directions) + centre
    grid = source / source.new_tensor(size[::-1]) * 2 - 1
    # beyond the reach the distortion is not one-to-one
    return grid, (directions.norm(dim=-1) < _reach(lens)) & (grid.abs() <= 1).all(-1)

"""Photos of a lens that bends rays, turned into photos of a pinhole camera."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.data.frames import Intrinsics
from qgs.data.lenses import Lens
from qgs.geometry.rays import pixel_directions


def undistorted(
    pixels: np.ndarray,
    intrinsics: Intrinsics,
    lens: Lens,
    mode: Literal["bilinear", "nearest"] = "bilinear",
) -> np.ndarray:
    """The photo as a pinhole camera with the same intrinsics would have taken it.

    pixels: (H, W) or (H, W, C), returned in the same shape and dtype. intrinsics: in pixels of it.
    What the lens did not see is 0.
    """
    height, width = pixels.shape[:2]
    grid, seen = _source_grid(intrinsics, lens, (height, width))
    planes = torch.from_numpy(pixels.reshape(height, width, -1)).permute(2, 0, 1).float()
    flat = F.grid_sample(
        planes[None], grid[None], mode=mode, padding_mode="border", align_corners=False
    )[0]
    flat = flat * seen
    result = flat.permute(1, 2, 0).numpy().reshape(pixels.shape)
    if np.issubdtype(pixels.dtype, np.integer):
        result = result.round()
    return result.astype(pixels.dtype)


def _source_grid(
    intrinsics: Intrinsics, lens: Lens, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Where in the photo each pinhole pixel is to be found, and whether it is there.

    (H, W, 2), from -1 to 1 across the photo, and (H, W).
    """
    camera = torch.tensor(intrinsics)
    focal, centre = camera.split(2)
    directions = pixel_directions(camera, size)[..., :2]
    source = focal * lens.distorted(directions) + centre
    grid = source / torch.tensor(size[::-1]) * 2 - 1
    return grid, lens.sees(directions) & (grid.abs() <= 1).all(-1)

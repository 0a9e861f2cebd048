"""Photos with lens distortion turned into pinhole photos (OpenCV's model)."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from qgs.geometry.rays import pixel_directions


def undistorted(
    image: Image.Image,
    intrinsics: tuple[float, float, float, float],
    distortion: tuple[float, ...],
) -> Image.Image:
    """The photo as a pinhole camera with the same intrinsics would have taken it.

    distortion: k1, k2, p1, p2, k3. Pixels that the lens did not see are black.
    """
    width, height = image.size
    focal, centre = torch.tensor(intrinsics).split(2)
    directions = pixel_directions(torch.tensor(intrinsics), (height, width))[..., :2]
    source = focal * distorted(directions, distortion) + centre
    grid = source / torch.tensor([width, height]) * 2 - 1
    pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1).float()
    flat = F.grid_sample(pixels[None], grid[None], align_corners=False)[0]
    return Image.fromarray(flat.round().byte().permute(1, 2, 0).numpy())


def distorted(points: Tensor, distortion: tuple[float, ...]) -> Tensor:
    """Where the lens puts points (..., 2) of the plane z = 1 (OpenCV's radial-tangential model)."""
    k1, k2, p1, p2, k3 = distortion
    x, y = points.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return torch.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )

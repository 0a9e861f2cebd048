"""Photos with lens distortion turned into pinhole photos (OpenCV's model)."""

from __future__ import annotations

import numpy as np
import torch
from PIL import Image


def undistorted(
    image: Image.Image,
    intrinsics: tuple[float, float, float, float],
    distortion: tuple[float, ...],
) -> Image.Image:
    """The photo as a pinhole camera with the same intrinsics would have taken it.

    distortion: k1, k2, p1, p2, k3.
    Pixels that the lens did not see are black.
    """
    from kornia.geometry.calib import undistort_image  # slow to import, seldom needed

    fx, fy, cx, cy = intrinsics
    matrix = torch.tensor([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1).float().div(255)
    coefficients = torch.tensor(distortion)
    flat = undistort_image(pixels[None], matrix[None], coefficients[None])[0]
    array = flat.clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).numpy()
    return Image.fromarray(array)

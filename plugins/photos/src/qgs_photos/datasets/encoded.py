"""A photo as an encoded file."""

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from qgs.data.photos.reader import Intrinsics, Lens, Size


@dataclass(frozen=True)
class EncodedFrame:
    """A photo as an encoded file, and its camera.

    name: file name. data: bytes of the image file. c2w: camera-to-world (4, 4), float64, OpenCV
    axes. intrinsics: fx, fy, cx, cy in pixels. size: (H, W) of the photo. lens: distortion; None
    for a pinhole camera. mask: (H, W) uint8; None for a photo without a mask.
    """

    name: str
    data: bytes
    c2w: np.ndarray
    intrinsics: Intrinsics
    size: Size
    lens: Lens | None = None
    mask: np.ndarray | None = None


def as_intrinsics(values: np.ndarray | Tensor) -> Intrinsics:
    """Return fx, fy, cx, cy (4,) as a tuple of numbers."""
    fx, fy, cx, cy = values.tolist()
    return fx, fy, cx, cy

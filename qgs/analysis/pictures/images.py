"""Pictures and cameras of other sizes, and grounds to draw on."""

from __future__ import annotations

import numpy as np
from PIL import Image

from qgs.io.drawing import Picture
from qgs.types import Cameras


def enlarged(picture: Picture, side: int, *, smooth: bool = False) -> Picture:
    """The picture with its longer side at `side` pixels; sharp pixels unless `smooth`."""
    height, width = picture.shape[:2]
    factor = side / max(height, width)
    size = (round(width * factor), round(height * factor))
    resample = Image.Resampling.BICUBIC if smooth else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(picture).resize(size, resample))


def finer(cameras: Cameras, side: int) -> Cameras:
    """The same cameras with at least `side` pixels on the longer side, a whole multiple."""
    height, width = cameras.size
    factor = max(1, round(side / max(height, width)))
    return Cameras(cameras.c2w, cameras.intrinsics * factor, (height * factor, width * factor))


def washed(picture: Picture, strength: float = 0.6) -> Picture:
    """Greys, lightened towards white by `strength`: a ground to draw on."""
    grey = picture.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    light = 255 - (255 - grey) * (1 - strength)
    return np.repeat(light[..., None], 3, -1).round().astype(np.uint8)

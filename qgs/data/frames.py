"""What a listing of photos says of each of them, before any image is opened."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from upath import UPath

from qgs.data.lenses import Lens

Intrinsics: TypeAlias = tuple[float, float, float, float]
Size: TypeAlias = tuple[int, int]


@dataclass(frozen=True)
class Fault:
    """Something wrong with a frame, and what to do; readers refuse frames with fatal ones."""

    reason: str
    fix: str
    fatal: bool = True

    def __str__(self) -> str:
        return f"{self.reason}: {self.fix}"


@dataclass(frozen=True)
class PhotoFrame:
    """One photo as listed; nothing of it is judged yet (see `qgs.data.validation`).

    name: the image file relative to the scene's folder. path: that file; mask, depth: those that go
    with it. A mask that is the image itself is its alpha channel. c2w: (4, 4) float64 OpenCV
    camera-to-world. intrinsics: fx, fy, cx, cy in pixels of an image of `size` (H, W), or of the
    file where the listing gives no size. lens: None for a pinhole. split: what the listing uses it
    for; None where it says nothing. faults: what the listing says that cannot be read; a pose or
    intrinsics concerned are NaN.
    """

    name: str
    path: UPath
    c2w: np.ndarray
    intrinsics: Intrinsics
    size: Size | None = None
    lens: Lens | None = None
    mask: UPath | None = None
    depth: UPath | None = None
    split: Literal["train", "test", "unused"] | None = None
    faults: tuple[Fault, ...] = ()

    def at_size(self, size: Size) -> Intrinsics:
        """Intrinsics in pixels of an image file of `size`, a scaled copy of what is listed."""
        height, width = self.size or size
        x, y = size[1] / width, size[0] / height
        fx, fy, cx, cy = self.intrinsics
        return fx * x, fy * y, cx * x, cy * y

"""Scenes whose photos can be had as they are stored, for packing without loss."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from qgs.contracts import Scene
from qgs.data.lenses import Lens


@dataclass(frozen=True)
class EncodedFrame:
    """A photo as it is stored, and the camera that took it.

    data, mask: bytes of image files; mask None for a frame without one. c2w: (4, 4) float64, OpenCV
    axes. intrinsics: fx, fy, cx, cy in pixels of the stored photo, whose size is (H, W).
    lens: None for a pinhole. background: RGB in [0, 1] behind transparent pixels.
    """

    name: str
    data: bytes
    c2w: np.ndarray
    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    lens: Lens | None = None
    mask: bytes | None = None
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)


class EncodedScene(Scene):
    """A scene that is stored as image files."""

    @abstractmethod
    def encoded(self, frame: int) -> EncodedFrame:
        """A frame as it is stored. Raises ValueError for a file that cannot be read."""

"""Intrinsics of a photo as numbers."""

import numpy as np
from torch import Tensor

from qgs.data.photos.reader import Intrinsics


def as_intrinsics(values: np.ndarray | Tensor) -> Intrinsics:
    """Return fx, fy, cx, cy (4,) as a tuple of numbers."""
    fx, fy, cx, cy = values.tolist()
    return fx, fy, cx, cy

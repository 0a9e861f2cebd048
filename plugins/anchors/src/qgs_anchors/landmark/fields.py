"""State fields of a query's footprint, which is the part of a photo that the query starts from."""

import torch
from torch import Tensor

from qgs.contracts import Fields, FieldSpec
from qgs.precision import full_precision

COLORS = "landmark.colors"
FOOTPRINT = "landmark.footprint"
FRAME = "landmark.frame"

FRAME_FIELD: Fields = {
    FRAME: FieldSpec((3, 3), frame="world", encoding="rows: right, down, ahead in the photo")
}
"""Field of the camera axes of each query's photo (B, N, 3, 3): unit vectors as rows."""
FOOTPRINT_FIELD: Fields = {
    FOOTPRINT: FieldSpec((3,), encoding="width and height in sides, rows of cells")
}
"""Field of the shapes of footprints (B, N, 3): width, height, and number of rows of their cells.

Width and height are multiples of the side of a square with the footprint's area. A footprint may be
divided into a grid of cells; if not, the number of rows is 0. All queries have the same shape."""


def color_field(count: int) -> Fields:
    """Return the state field of mean colours (B, N, K, 3) of each footprint's K = `count` cells."""
    return {COLORS: FieldSpec((count, 3), encoding=f"mean RGB of {count} cells of the footprint")}


@full_precision
def in_world(steps_BNx3: Tensor, frame_BN33: Tensor) -> Tensor:
    """Convert steps from the axes of the camera of each query's photo to the world frame.

    steps: (B, N, 3) or (B, N, K, 3), along the axes right, down and ahead. frame: these axes in the
    world frame, as rows (B, N, 3, 3).
    """
    return torch.einsum("bn...i,bnij->bn...j", steps_BNx3, frame_BN33)

"""State fields of a query's footprint: the part of a photo in which the query starts."""

from torch import Tensor

from qgs.contracts import Fields, FieldSpec
from qgs.precision import full_precision

COLORS = "landmark.colors"
FOOTPRINT = "landmark.footprint"
FRAME = "landmark.frame"

FRAME_FIELD: Fields = {
    FRAME: FieldSpec((3, 3), frame="world", encoding="rows: right, down, ahead in the photo")
}
"""Axes of a query's photo (B, N, 3, 3), unit vectors."""
FOOTPRINT_FIELD: Fields = {
    FOOTPRINT: FieldSpec((3,), encoding="width and height in sides, rows of cells")
}
"""Shape of a query's footprint (B, N, 3): width, height and number of rows of its cells.

Width and height are in sides of a square of the same area. The number of rows is 0 if there are no
cells. All queries of a set of photos have the same shape."""


def color_field(count: int) -> Fields:
    """Return the field of the colours of K = `count` cells of a footprint (B, N, K, 3)."""
    return {COLORS: FieldSpec((count, 3), encoding=f"mean RGB of {count} cells of the footprint")}


@full_precision
def in_world(steps_BNx3: Tensor, frame_BN33: Tensor) -> Tensor:
    """Return steps right, down and ahead, (B, N, 3) or (B, N, K, 3), as world vectors."""
    if steps_BNx3.ndim == frame_BN33.ndim:
        return steps_BNx3 @ frame_BN33
    return (steps_BNx3[:, :, None] @ frame_BN33)[:, :, 0]

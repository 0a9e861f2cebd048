"""What a query knows of the square of a photo that it starts from, its footprint."""

from torch import Tensor

from qgs.contracts import Fields, FieldSpec
from qgs.geometry.precision import full_precision

COLORS = "landmark.colors"
FRAME = "landmark.frame"

FRAME_FIELD: Fields = {
    FRAME: FieldSpec((3, 3), frame="world", encoding="rows: right, down, ahead in the photo")
}
"""Axes (B, N, 3, 3) of a query's photo. The first two are as long as its footprint is wide and
high, in sides of a square of that area; the last is 1 long."""


def color_field(count: int) -> Fields:
    """The colours of the K = `count` cells of a footprint (B, N, K, 3)."""
    return {COLORS: FieldSpec((count, 3), encoding=f"mean RGB of {count} cells of the footprint")}


@full_precision
def in_world(steps_BNx3: Tensor, frame_BN33: Tensor) -> Tensor:
    """Steps to the right, down and ahead, (B, N, 3) or (B, N, K, 3), as world vectors."""
    if steps_BNx3.ndim == frame_BN33.ndim:
        return steps_BNx3 @ frame_BN33
    return (steps_BNx3[:, :, None] @ frame_BN33)[:, :, 0]

"""What a query knows of the square of a photo that it starts from, its footprint."""

from qgs.contracts import Fields, FieldSpec

COLORS = "landmark.colors"
PLANE = "landmark.plane"


def footprint_fields(count: int) -> Fields:
    """Colours of K = `count` cells (B, N, K, 3), and directions of the photo (B, N, 2, 3)."""
    colors = FieldSpec((count, 3), encoding=f"mean RGB of {count} cells of the footprint")
    axes = "unit vectors to the right and down in the photo"
    return {COLORS: colors, PLANE: FieldSpec((2, 3), frame="world", encoding=axes)}

"""Pictures of errors, and of what one query reads in the input photos."""

import numpy as np
from torch import Tensor

from qgs.drawing.images import Picture, enlarged, rgb_picture, shaded, side_by_side
from qgs_viewer.queries import attention_pictures, patch_maps
from qgs_viewer.query_scene import QueryScene

COLUMNS = 2
ERROR_MAP = "inferno"
PARTS = {"result": "attention", "content": "content logits", "geometry": "geometry bias"}


def color_error(images: Tensor, truth: Tensor) -> Tensor:
    """Return the mean over channels of the error of clipped images, (..., 1, H, W)."""
    return (images.clamp(0, 1) - truth.to(images)).abs().mean(-3, keepdim=True)


def error_picture(error: Tensor, most: float) -> Picture:
    """Paint error (1, H, W) from none (black) to `most` and above (light yellow)."""
    return shaded(error, 0.0, most, ERROR_MAP)


def attention_pictures_of(
    scene: QueryScene, query: int, layer: int, side: int
) -> dict[str, list[Picture]]:
    """Colour photos by what a query attends to, by PARTS; less those it lacks; means over heads.

    side: pixels on the longer side of each photo.
    """
    found = scene.attention(query, layer)
    if found is None or scene.views is None:
        return {}
    photos = [enlarged(rgb_picture(image), side) for image in scene.views.images[0]]
    values = {"result": found.weights, "content": found.content, "geometry": found.geometry}
    return {
        part: attention_pictures(photos, patch_maps(value[0, :, 0], scene.grid))
        for part, value in values.items()
        if value is not None
    }


def sheet(pictures: list[Picture]) -> Picture:
    """Put all pictures into one, COLUMNS in a row."""
    columns = min(COLUMNS, len(pictures))
    # the last row may lack some
    blank = np.full_like(pictures[0], 255)
    rows = []
    for first in range(0, len(pictures), columns):
        row = [*pictures[first : first + columns], *[blank] * columns]
        rows.append(side_by_side(row[:columns]))
    return np.concatenate(rows)

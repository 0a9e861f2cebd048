"""Pictures of errors, and of what one query reads in the input photos."""

import numpy as np
from torch import Tensor

from qgs.drawing.images import Picture, enlarged, rgb_picture, shaded, side_by_side
from qgs_viewer.look import Look
from qgs_viewer.queries import attention_pictures, patch_maps

COLUMNS = 2
ERROR_MAP = "inferno"
PARTS = {"result": "attention", "content": "content logits", "geometry": "geometry bias"}
Parts = dict[str, list[Picture]]


def color_error(images: Tensor, truth: Tensor) -> Tensor:
    """Mean over channels of what clipped images are off, (..., 3, H, W) -> (..., 1, H, W)."""
    return (images.clamp(0, 1) - truth.to(images)).abs().mean(-3, keepdim=True)


def error_picture(error: Tensor, most: float) -> Picture:
    """Error (1, H, W) from none (black) to `most` and above (light yellow)."""
    return shaded(error, 0.0, most, ERROR_MAP)


def attention_pictures_of(look: Look, query: int, layer: int, side: int) -> Parts:
    """Photos coloured by what a query attends to, by PARTS; less those it lacks; means over heads.

    side: pixels on the longer side of each photo.
    """
    weights = look.attention(query, layer)
    if weights is None or look.views is None:
        return {}
    photos = [enlarged(rgb_picture(image), side) for image in look.views.images[0]]
    parts = (weights.weights, weights.content, weights.geometry)
    return {
        name: attention_pictures(photos, patch_maps(part[0, :, 0], look.grid))
        for name, part in zip(PARTS, parts, strict=True)
        if part is not None
    }


def sheet(pictures: list[Picture]) -> Picture:
    """All pictures in one, COLUMNS in a row."""
    columns = min(COLUMNS, len(pictures))
    padded = [*pictures, *[np.full_like(pictures[0], 255)] * (-len(pictures) % columns)]
    rows = range(0, len(padded), columns)
    return np.concatenate([side_by_side(padded[row : row + columns]) for row in rows], 0)

"""Pictures of errors, and of what one query reads in the input photos."""

import numpy as np
from torch import Tensor

from qgs.drawing.images import Picture, enlarged, rgb_picture, shaded, side_by_side
from qgs_viewer.look import Look
from qgs_viewer.queries import attention_pictures, patch_maps

SIDE = 192
"""Pixels on the longer side of each photo."""
COLUMNS = 2
ERROR_MAP = "inferno"
PARTS = ("result", "content", "geometry")


def color_error(images: Tensor, truth: Tensor) -> Tensor:
    """Mean over channels of what clipped images are off, (..., 3, H, W) -> (..., 1, H, W)."""
    return (images.clamp(0, 1) - truth.to(images)).abs().mean(-3, keepdim=True)


def error_picture(error: Tensor, most: float) -> Picture:
    """Error (1, H, W) from none (black) to `most` and above (light yellow)."""
    return shaded(error, 0.0, most, ERROR_MAP)


def attention_parts(look: Look, query: int, layer: int) -> dict[str, Picture]:
    """Attention, content logits and geometry bias of a query, by PARTS; less those it lacks.

    All input photos in one picture, COLUMNS in a row; means over heads.
    """
    weights = look.attention(query, layer)
    if weights is None or look.views is None:
        return {}
    photos = [enlarged(rgb_picture(image), SIDE) for image in look.views.images[0]]
    parts = (weights.weights, weights.content, weights.geometry)
    return {
        name: _sheet(attention_pictures(photos, patch_maps(part[0, :, 0], look.grid)))
        for name, part in zip(PARTS, parts, strict=True)
        if part is not None
    }


def _sheet(pictures: list[Picture]) -> Picture:
    blank = np.full_like(pictures[0], 255)
    rows = [pictures[start : start + COLUMNS] for start in range(0, len(pictures), COLUMNS)]
    columns = min(COLUMNS, len(pictures))
    rows = [side_by_side([*row, *[blank] * (columns - len(row))]) for row in rows]
    return np.concatenate(rows, 0)

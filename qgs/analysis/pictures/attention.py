"""Attention of a query over the patches of the input views."""

from __future__ import annotations

import numpy as np
from PIL import Image
from torch import Tensor

from qgs.analysis.pictures.images import washed
from qgs.analysis.pictures.palette import ATTENTION_MAP
from qgs.io.drawing import Picture


def patch_maps(row_M: Tensor, grid: tuple[int, int, int]) -> np.ndarray:
    """Scores (M,) of image tokens as one map per view (V, H/P, W/P)."""
    return row_M.detach().float().cpu().reshape(grid).numpy()


def attention_pictures(photos: list[Picture], maps: np.ndarray) -> list[Picture]:
    """Each photo in pale grey with its map on top; the views share one colour scale."""
    from matplotlib import colormaps

    low, high = float(maps.min()), float(maps.max())
    shades = (maps - low) / max(high - low, 1e-12)
    pictures = []
    for photo, shade in zip(photos, shades, strict=True):
        height, width = photo.shape[:2]
        patches = Image.fromarray((shade * 255).round().astype(np.uint8))
        cells = np.asarray(patches.resize((width, height), Image.Resampling.NEAREST)) / 255
        color = colormaps[ATTENTION_MAP](cells)[..., :3] * 255
        mixed = 0.72 * color + 0.28 * washed(photo, 0.2)
        pictures.append(mixed.round().astype(np.uint8))
    return pictures

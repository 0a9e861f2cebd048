"""Pictures to files: PNG and animated GIF, whole or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from qgs.io.atomic import replacing


def png_bytes(picture: np.ndarray) -> bytes:
    """A uint8 (H, W, 3) picture as the bytes of a PNG file."""
    buffer = BytesIO()
    _checked(picture).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def write_png(picture: np.ndarray, path: str | Path) -> None:
    """Write a uint8 (H, W, 3) picture."""
    data = png_bytes(picture)
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_gif(frames: Sequence[np.ndarray], path: str | Path, frames_per_second: float) -> None:
    """Write uint8 (H, W, 3) frames of one size as a GIF that loops for ever.

    All frames share one palette, so that flat areas do not flicker. Raises ValueError for no
    frames or frames of several sizes.
    """
    sizes = {frame.shape for frame in frames}
    if len(sizes) != 1:
        raise ValueError(f"a GIF needs frames of one size, got {sorted(sizes) or 'none'}")
    images = [_checked(frame) for frame in frames]
    sample = Image.fromarray(np.concatenate(frames[:: max(1, len(frames) // 8)]))
    palette = sample.quantize(256, method=Image.Quantize.MEDIANCUT)
    paletted = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    with replacing(path) as temporary:
        paletted[0].save(
            temporary,
            format="GIF",
            save_all=True,
            append_images=paletted[1:],
            duration=round(1000 / frames_per_second),
            loop=0,
        )


def _checked(picture: np.ndarray) -> Image.Image:
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise ValueError(
            f"a picture must be uint8 (H, W, 3), got {picture.dtype} {tuple(picture.shape)}"
        )
    return Image.fromarray(picture)

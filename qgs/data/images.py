"""Image files to pixels of the wanted size, and the intrinsics that follow them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from upath import UPath


@dataclass(frozen=True)
class CropResize:
    """A centre crop to the target's aspect ratio, then a resize.

    source, target: (H, W) in pixels. The crop may end between pixels.
    """

    source: tuple[int, int]
    target: tuple[int, int]

    @property
    def scale(self) -> float:
        """Target pixels per source pixel, the same along both axes."""
        return max(self.target[0] / self.source[0], self.target[1] / self.source[1])

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom edge of the crop, in source pixels."""
        height, width = (extent / self.scale for extent in self.target)
        top, left = (self.source[0] - height) / 2, (self.source[1] - width) / 2
        return max(left, 0.0), max(top, 0.0), left + width, top + height

    def intrinsics(self, source: Tensor) -> Tensor:
        """fx, fy, cx, cy (..., 4) after the crop (shift), then the resize (scale)."""
        left, top, _, _ = self.box
        return (source - source.new_tensor([0.0, 0.0, left, top])) * self.scale

    def image(self, image: Image.Image) -> np.ndarray:
        """`image`, of the source's size, as (H, W, 3) uint8, or (H, W) where it has one channel.

        Lanczos filter over the area.
        """
        height, width = self.target
        left, top, right, bottom = self.box
        box = (left, top, min(right, self.source[1]), min(bottom, self.source[0]))
        return np.array(image.resize((width, height), Image.Resampling.LANCZOS, box=box))


def open_rgb(path: Path | UPath, background: tuple[float, float, float]) -> Image.Image:
    """The image file as RGB, composited over `background` (in [0, 1]) where it is transparent.

    Raises ValueError for a file that is no readable image.
    """
    try:
        with path.open("rb") as file:
            return decode_rgb(file, background)
    except OSError as error:
        raise ValueError(
            f"{path} cannot be read as an image ({error}): replace the file, or remove its frame"
        ) from error


def decode_rgb(file: IO[bytes], background: tuple[float, float, float]) -> Image.Image:
    """As `open_rgb`, for an open file. Raises OSError for bytes that are no readable image."""
    image = _decoded(file)
    if image.has_transparency_data:
        image = image.convert("RGBA")
        color = tuple(round(255 * channel) for channel in background)
        canvas = Image.new("RGBA", image.size, (*color, 255))
        image = Image.alpha_composite(canvas, image)
    return image if image.mode == "RGB" else image.convert("RGB")


def decode_gray(file: IO[bytes]) -> Image.Image:
    """An open image file as one 8-bit channel. Raises OSError as `decode_rgb`."""
    return _decoded(file).convert("L")


def _decoded(file: IO[bytes]) -> Image.Image:
    try:
        with Image.open(file) as image:
            image.load()
    except (SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise OSError(str(error)) from error
    return image


def to_tensor(images: np.ndarray) -> Tensor:
    """(F, H, W, 3) uint8 -> (F, 3, H, W) float32 in [0, 1]."""
    return torch.from_numpy(images).permute(0, 3, 1, 2).float().div_(255).contiguous()

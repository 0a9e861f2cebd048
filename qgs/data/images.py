"""Image, mask and depth files to pixels of the wanted size, and the intrinsics that follow them."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from upath import UPath

_UNREADABLE = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)


@dataclass(frozen=True)
class CropResize:
    """A centre crop to the target's aspect ratio, then a resize; (H, W) in pixels."""

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
        right, bottom = min(left + width, self.source[1]), min(top + height, self.source[0])
        return max(left, 0.0), max(top, 0.0), right, bottom

    def intrinsics(self, source: Tensor) -> Tensor:
        """fx, fy, cx, cy (..., 4) after the crop (shift), then the resize (scale)."""
        left, top, _, _ = self.box
        return (source - source.new_tensor([0.0, 0.0, left, top])) * self.scale

    def image(
        self, image: Image.Image, kernel: Image.Resampling = Image.Resampling.LANCZOS
    ) -> np.ndarray:
        """`image`, of the source's size, as (H, W, 3) uint8, or (H, W) where it has one channel."""
        return np.array(image.resize((self.target[1], self.target[0]), kernel, box=self.box))


@contextmanager
def _readable(path: Path | UPath, kind: str) -> Iterator[None]:
    try:
        yield
    except _UNREADABLE as error:
        raise ValueError(
            f"{path} cannot be read as {kind} ({error}): replace the file, or remove its frame"
        ) from error


def image_size(path: UPath) -> tuple[int, int]:
    """(H, W) in the header of an image file. Raises ValueError for a file that is no image."""
    with _readable(path, "an image"), path.open("rb") as file, Image.open(file) as image:
        return image.height, image.width


def open_rgb(path: Path | UPath, background: tuple[float, float, float]) -> Image.Image:
    """The file as RGB, over `background` in [0, 1]. Raises ValueError where it is unreadable."""
    with _readable(path, "an image"), path.open("rb") as file:
        return decode_rgb(file, background)


def open_mask(path: UPath) -> np.ndarray:
    """A mask as (H, W) uint8, 255 for what is modelled; 0/1 files too. Raises ValueError."""
    with _readable(path, "the mask of a photo"), path.open("rb") as file:
        grey = np.array(decode_gray(file))
    return grey * np.uint8(255) if grey.max() == 1 else grey


def alpha_mask(path: UPath) -> np.ndarray:
    """The alpha channel of a photo as (H, W) uint8; 255 for one without. Raises as `open_mask`."""
    with _readable(path, "an image"), path.open("rb") as file:
        image = _decoded(file)
    if not image.has_transparency_data:
        return np.full((image.height, image.width), 255, np.uint8)
    return np.array(image.convert("RGBA").getchannel("A"))


def open_depth(path: UPath, unit: float) -> np.ndarray:
    """A depth map as (H, W) float32; unit: world units per number; 0: unknown. ValueError."""
    with _readable(path, "a depth map"), path.open("rb") as file:
        if path.suffix.lower() == ".npy":
            depth = np.asarray(np.load(file, allow_pickle=False)).squeeze()
        else:
            depth = np.array(_decoded(file))
    if depth.ndim != 2 or depth.dtype.kind not in "fiu":
        raise ValueError(
            f"{path} must hold one number for each pixel, got {depth.dtype} {depth.shape}: give "
            "16-bit images or .npy files, or remove 'depth_file_path'"
        )
    metric = (depth * unit).astype(np.float32)
    return np.where(np.isfinite(metric), metric, np.float32(0))


def decode_rgb(file: IO[bytes], background: tuple[float, float, float]) -> Image.Image:
    """As `open_rgb`, for an open file. Raises OSError for bytes that are no readable image."""
    image = _decoded(file)
    if image.has_transparency_data:
        color = tuple(round(255 * channel) for channel in background)
        canvas = Image.new("RGBA", image.size, (*color, 255))
        image = Image.alpha_composite(canvas, image.convert("RGBA"))
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

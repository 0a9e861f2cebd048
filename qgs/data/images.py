"""Decoding of images, masks and depth maps, and crops that adapt camera intrinsics."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import IO, TypeVar

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from rich.filesize import decimal
from torch import Tensor
from upath import UPath

from qgs.machine import is_out_of_memory
from qgs.paths import LARGEST, open_file
from qgs.types import Size
from qgs.wording import name_shown

TURNED = "have an EXIF orientation, which is ignored; pixels are read as stored"
TURN = "poses must belong to the stored pixels; `mogrify -auto-orient` rotates the stored pixels"

_EIGHT_BITS = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr", "HSV")
# Formats of photos; other formats, such as EPS, would start programs.
_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "DIB", "GIF", "PPM", "JPEG2000", "TGA", "AVIF")
# An image of this size takes 2 GB with transparency; the largest phone photos have 108 million.
_MOST_PIXELS = 120_000_000
# EXIF tag.
_ORIENTATION = 0x0112
# First bytes of a .npy file.
_NPY = b"\x93NUMPY"

Decoded = TypeVar("Decoded")


@dataclass(frozen=True)
class CropResize:
    """Centre crop to the aspect ratio of a target size, then resize to the target size.

    source, target: sizes (H, W) in pixels.
    zoom: factor, at least 1, by which the crop is smaller than the largest possible crop.
    """

    source: Size
    target: Size
    zoom: float = 1.0

    @property
    def scale(self) -> float:
        """Number of target pixels per source pixel, the same along both axes."""
        return self.zoom * max(self.target[0] / self.source[0], self.target[1] / self.source[1])

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom edge of the crop, in source pixels."""
        height, width = self.source
        down = self.target[0] / self.scale
        across = self.target[1] / self.scale
        left = (width - across) / 2
        top = (height - down) / 2
        # Clamped, because rounding could move an edge outside the image.
        return max(left, 0.0), max(top, 0.0), min(left + across, width), min(top + down, height)

    def intrinsics(self, source: Tensor) -> Tensor:
        """Return intrinsics fx, fy, cx, cy (..., 4) in pixels of the resized crop.

        source: intrinsics (..., 4) in pixels of the whole image.
        """
        left, top, _, _ = self.box
        return (source - source.new_tensor([0.0, 0.0, left, top])) * self.scale

    def image(
        self, image: Image.Image, kernel: Image.Resampling = Image.Resampling.LANCZOS
    ) -> np.ndarray:
        """Return `image` cropped and resized, as (H, W, 3) uint8, or (H, W) for one channel."""
        return np.array(image.resize((self.target[1], self.target[0]), kernel, box=self.box))


def read_image(path: Path | UPath, decode: Callable[[IO[bytes]], Decoded]) -> Decoded:
    """Return the result of `decode` for the file at `path`; raise ValueError if `decode` fails."""
    try:
        with open_file(path) as file:
            return decode(file)
    except Exception as error:
        # The file is not at fault.
        if is_out_of_memory(error):
            raise
        reason = str(error) or type(error).__name__
        raise ValueError(
            f"{name_shown(str(path))} cannot be read as an image ({reason}): replace the file, or "
            "remove its frame"
        ) from error


def image_size(file: IO[bytes]) -> Size:
    """Return (H, W) from the header of an image file; raise OSError if the file is no image."""
    with opened_image(file) as image:
        return image.height, image.width


def orientation(image: Image.Image) -> int:
    """Return the EXIF orientation of an image, 1 to 8; 1 means stored upright."""
    try:
        return image.getexif().get(_ORIENTATION, 1)
    # Pillow raises any kind of error for damaged EXIF, which is ignored.
    except Exception:
        return 1


def decode_alpha(file: IO[bytes]) -> np.ndarray:
    """Decode the alpha channel of a photo as (H, W) uint8.

    All values are 255 for a photo without alpha channel. Raises OSError for an unreadable file.
    """
    return np.array(eight_bits(_decoded(file)).convert("RGBA").getchannel("A"))


def decode_depth(file: IO[bytes], unit: float = 1.0) -> np.ndarray:
    """Decode a depth map, an image or .npy file, as (H, W) float32; 0 means unknown.

    unit: depth in world units that the value 1 in the file means. Raises OSError or ValueError for
        an unreadable file.
    """
    plain = file.read(len(_NPY)) == _NPY
    file.seek(0)
    depth = load_array(file).squeeze() if plain else np.array(_decoded(file))
    if depth.ndim != 2 or depth.dtype.kind not in "fiu":
        raise OSError(
            "a depth map must have one channel of numbers, as 16-bit images have, got "
            f"{depth.dtype} of shape {depth.shape}"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        metric = (depth * unit).astype(np.float32)
    return np.where(np.isfinite(metric), metric, np.float32(0))


def load_array(file: IO[bytes]) -> np.ndarray:
    """Read a .npy file; raise ValueError for Python objects and for arrays of too many bytes."""
    # NumPy allocates the size in the header, so a tiny damaged file could ask for all memory.
    form = np.lib.format
    first = form.read_magic(file) == (1, 0)
    header = form.read_array_header_1_0 if first else form.read_array_header_2_0
    shape, _, dtype = header(file)
    size = math.prod(shape) * dtype.itemsize
    if size > LARGEST:
        raise ValueError(f"the array is too large, {decimal(size)}: scale it down")
    file.seek(0)
    return np.load(file, allow_pickle=False)


def decode_rgb(
    file: IO[bytes], background: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Image.Image:
    """Decode an image as RGB, (H, W, 3) uint8; raise OSError for an unreadable file.

    background: RGB colour in [0, 1] behind transparent pixels. The EXIF orientation is not applied;
        `PhotoScene` applies it.
    """
    image = eight_bits(_decoded(file))
    if image.has_transparency_data:
        color = tuple(round(255 * channel) for channel in background)
        canvas = Image.new("RGBA", image.size, (*color, 255))
        image = Image.alpha_composite(canvas, image.convert("RGBA"))
    return image if image.mode == "RGB" else image.convert("RGB")


def eight_bits(image: Image.Image) -> Image.Image:
    """Convert `image` to 8 bits per channel.

    Raises OSError for pixel formats in which the value of white is unknown: float, 32-bit and LAB.
    """
    if image.mode.startswith("I;16"):
        numbers = np.array(image).astype(np.uint32)
        # Rounded, so that 65535 becomes 255.
        return Image.fromarray(((numbers + 128) // 257).astype(np.uint8))
    if image.mode not in _EIGHT_BITS:
        raise OSError(f"its pixels have Pillow's mode {image.mode!r}: use 8 or 16 bits per channel")
    return image


def decode_mask(file: IO[bytes]) -> np.ndarray:
    """Decode a mask as (H, W) uint8, 255 for pixels to reconstruct and 0 for others.

    A file whose largest value is 1 is scaled to 255. Raises OSError if the file is not an image, or
    has colours or transparency.
    """
    rgba = np.array(eight_bits(_decoded(file)).convert("RGBA"))
    grey = rgba[..., 0]
    if (rgba[..., 1:3] != rgba[..., :1]).any() or (rgba[..., 3] != 255).any():
        raise OSError("the mask has colours or transparency: use a grey image, white on the object")
    # Some tools write 0 and 1.
    return grey * np.uint8(255) if grey.max() == 1 else grey


def _decoded(file: IO[bytes]) -> Image.Image:
    with opened_image(file) as image:
        image.load()
    return image


@cache
def _formats() -> tuple[str, ...]:
    """Return the names of readable image formats; HEIC only if pillow-heif is installed."""
    try:
        import_module("pillow_heif").register_heif_opener()
    except ImportError:
        return _FORMATS
    return (*_FORMATS, "HEIF")


@contextmanager
def opened_image(file: IO[bytes]) -> Iterator[Image.Image]:
    """Open an image file without decoding its pixels, as a context manager.

    Errors of Pillow become OSError, including those raised in the `with` block.
    """
    try:
        with Image.open(file, formats=_formats()) as image:
            if image.width * image.height > _MOST_PIXELS:
                raise OSError(
                    f"the image is too large, {image.width} x {image.height} pixels: scale it down"
                )
            yield image
    except UnidentifiedImageError as error:
        raise OSError(
            "the file has no known image format; HEIC needs `pip install pillow-heif`"
        ) from error
    except (OSError, MemoryError):
        raise
    # Decoders raise any kind of error for damaged files.
    except Exception as error:
        raise OSError(str(error) or type(error).__name__) from error


def to_tensor(images: np.ndarray) -> Tensor:
    """Convert F images (F, H, W, 3) uint8 to (F, 3, H, W) float32 in [0, 1]."""
    return torch.from_numpy(images).permute(0, 3, 1, 2).float().div_(255).contiguous()

"""What lies beside photos in files: their size, masks and depth maps."""

from __future__ import annotations

import numpy as np
from PIL import Image
from upath import UPath

from qgs.data.frames import Size
from qgs.data.images import CropResize

_ERRORS = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)


def image_size(path: UPath) -> Size:
    """(H, W) of an image file, of which only the header is read.

    Raises ValueError for a file that is no image.
    """
    try:
        with path.open("rb") as file, Image.open(file) as image:
            return image.height, image.width
    except _ERRORS as error:
        raise ValueError(
            f"{path} cannot be read as an image ({error}): replace the file, or remove its frame"
        ) from error


def open_mask(path: UPath) -> np.ndarray:
    """A mask file as (H, W) uint8, 255 where the photo shows what is to be modelled.

    Files of zeros and ones are read as such. Raises ValueError for a file that is no image.
    """
    grey = np.array(_opened(path, "mask").convert("L"))
    return grey * np.uint8(255) if grey.max() == 1 else grey


def alpha_mask(path: UPath) -> np.ndarray:
    """The alpha channel of a photo as (H, W) uint8; 255 for one without. Raises as `open_mask`."""
    image = _opened(path, "image")
    if not image.has_transparency_data:
        return np.full((image.height, image.width), 255, np.uint8)
    return np.array(image.convert("RGBA").getchannel("A"))


def open_depth(path: UPath, unit: float) -> np.ndarray:
    """A depth map, an image of integers or a .npy file, as (H, W) float32 of world units.

    unit: world units per number of the file. What is not finite becomes 0, for unknown.
    Raises ValueError for another kind of file.
    """
    if path.suffix.lower() == ".npy":
        try:
            with path.open("rb") as file:
                depth = np.load(file, allow_pickle=False)
        except _ERRORS as error:
            raise ValueError(f"{path} cannot be read as a depth map ({error})") from error
        depth = depth.squeeze() if isinstance(depth, np.ndarray) else np.zeros(0)
    else:
        depth = np.array(_opened(path, "depth map"))
    if depth.ndim != 2 or depth.dtype.kind not in "fiu":
        raise ValueError(
            f"{path} must hold one number for each pixel, got {depth.dtype} {depth.shape}: give "
            "16-bit images or .npy files, or remove 'depth_file_path'"
        )
    metric = (depth * unit).astype(np.float32)
    return np.where(np.isfinite(metric), metric, np.float32(0))


def nearest(values: np.ndarray, crop: CropResize) -> np.ndarray:
    """Numbers (H, W) float32 of the source's size at the target's pixels, none of them mixed."""
    height, width = crop.target
    left, top, right, bottom = crop.box
    box = (left, top, min(right, crop.source[1]), min(bottom, crop.source[0]))
    image = Image.fromarray(values)
    return np.array(image.resize((width, height), Image.Resampling.NEAREST, box=box))


def _opened(path: UPath, kind: str) -> Image.Image:
    try:
        with path.open("rb") as file, Image.open(file) as image:
            image.load()
            return image
    except _ERRORS as error:
        raise ValueError(
            f"{path} cannot be read as the {kind} of a photo ({error}): replace the file, or "
            "remove it from its frame"
        ) from error

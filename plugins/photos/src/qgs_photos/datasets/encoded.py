"""Return photos as encoded files, without decoding them."""

import io
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from qgs.data.images import decode_rgb
from qgs.data.photos.reader import Intrinsics, Lens, Size
from qgs.data.photos.source import PhotoScene, turned, whole_mask
from qgs.paths import read_file


@dataclass(frozen=True)
class EncodedFrame:
    """A photo as an encoded file, and its camera.

    name: file name. data: bytes of the image file. c2w: camera-to-world (4, 4), float64, OpenCV
    axes. intrinsics: fx, fy, cx, cy in pixels. size: (H, W) of the photo. lens: distortion; None
    for a pinhole camera. mask: (H, W) uint8; None for a photo without a mask.
    """

    name: str
    data: bytes
    c2w: np.ndarray
    intrinsics: Intrinsics
    size: Size
    lens: Lens | None = None
    mask: np.ndarray | None = None


def as_intrinsics(values: np.ndarray | Tensor) -> Intrinsics:
    """Return fx, fy, cx, cy (4,) as a tuple of numbers."""
    fx, fy, cx, cy = values.tolist()
    return fx, fy, cx, cy


def encoded_photo(scene: PhotoScene, frame: int) -> EncodedFrame:
    """Return a photo as an encoded file, with its camera.

    The bytes are those of the photo's file, encoded again only if its EXIF data rotate it. Raises
    ValueError for a file that cannot be read.
    """
    photo = scene.photos[frame]
    size = scene.stored_size(frame)
    data = read_file(photo.path)
    # pixels are stored again only where EXIF turns them
    if photo.turns:
        file = io.BytesIO()
        turned(decode_rgb(io.BytesIO(data), scene.config.background), photo).save(file, "png")
        data = file.getvalue()
    return EncodedFrame(
        name=photo.name,
        data=data,
        c2w=photo.c2w,
        intrinsics=photo.at_size(size),
        size=size,
        lens=photo.lens,
        mask=photo.mask and np.array(turned(whole_mask(photo), photo)),
    )

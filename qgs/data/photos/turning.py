"""Photos whose EXIF says that they are to be turned, and their cameras with them."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from PIL import Image

from qgs.data.images import TURN, opened_image, orientation
from qgs.data.photos.reader import PhotoFrame, Size, size_problems
from qgs.paths import is_local
from qgs.wording import warn_once

_TURNS = {3: 2, 6: 1, 8: 3}
"""EXIF orientation to quarter turns clockwise; the others mirror, which no camera does."""
_QUARTER = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""Axes of a camera turned clockwise, in those of the camera before: its x was -y, its y was x."""


def upright(frame: PhotoFrame) -> PhotoFrame:
    """Return `frame` as EXIF turns its photo, camera and lens included; of a store as it is.

    Where the listed size is the upright one, so are the listed cameras; where size does not tell,
    as of squares and half turns, they are those of the stored pixels.
    """
    # Of a store each header would be a request.
    if not is_local(frame.path) or not frame.path.is_file():
        return frame
    size, turns = _header(str(frame.path), frame.path.stat().st_mtime_ns)
    if not turns:
        return frame
    frame = replace(frame, turns=turns)
    if not _quarters(_swapped(size), frame):
        return frame
    if turns % 2 and size[0] == size[1]:
        warn_once(f"square photos in {frame.path.parent} are turned by EXIF: {TURN}")
    frame = replace(frame, size=frame.size or size)
    for _ in range(turns):
        frame = _quarter(frame)
    return frame


def turned_size(size: Size, frame: PhotoFrame) -> Size:
    """Return (H, W) of a stored photo of `frame`, its mask or depth map, when it is upright."""
    return _swapped(size) if _quarters(size, frame) % 2 else size


def turned(image: Image.Image, frame: PhotoFrame) -> Image.Image:
    """Return the stored photo, mask or depth map, upright; one that was drawn upright stays."""
    quarters = _quarters((image.height, image.width), frame)
    # Pixels are moved, not interpolated; the angle is counterclockwise.
    return image.rotate(-90 * quarters, expand=True) if quarters else image


def _swapped(size: Size) -> Size:
    return size[1], size[0]


def _quarters(size: Size, frame: PhotoFrame) -> int:
    """Return the turns of a file of `size` (H, W); 0 where the listing says that it is upright."""
    fits, fits_turned = (not any(size_problems(own, frame.size)) for own in (size, _swapped(size)))
    return 0 if frame.turns % 2 and fits and not fits_turned else frame.turns


@lru_cache(maxsize=2**16)
def _header(path: str, changed: int) -> tuple[Size, int]:
    """Return (H, W) as stored and quarter turns; none of a file that is no image."""
    try:
        with open(path, "rb") as file, opened_image(file) as image:
            return (image.height, image.width), _TURNS.get(orientation(image), 0)
    except OSError:
        return (1, 1), 0


def _quarter(frame: PhotoFrame) -> PhotoFrame:
    """Turn camera, size and lens of `frame` by a quarter, clockwise."""
    assert frame.size is not None
    height, width = frame.size
    fx, fy, cx, cy = frame.intrinsics
    return replace(
        frame,
        size=(width, height),
        c2w=frame.c2w @ _QUARTER,
        intrinsics=(fy, fx, height - cy, cx),
        lens=frame.lens and frame.lens.turned(),
    )

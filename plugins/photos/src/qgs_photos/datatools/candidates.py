"""What a check looks at: scenes, and their photos as they are listed, before anything is judged."""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from qgs.data.images import decode_rgb
from qgs.data.lenses import Size, undistorted
from qgs.data.photos.reader import PhotoFrame
from qgs.data.photos.turning import turned


@dataclass(frozen=True)
class Photo:
    """A listed photo, what reads its bytes, and whether it and its mask exist.

    read_mask: reads a mask that is in no file, (H, W).
    """

    listed: PhotoFrame
    read: Callable[[], bytes]
    exists: bool = True
    mask_exists: bool = True
    read_mask: Callable[[], np.ndarray | None] | None = None

    def picture(self, size: Size | None, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Return pinhole RGB, at most `side` pixels long, and intrinsics (4,). Raises OSError."""
        frame = self.listed if self.listed.size else replace(self.listed, size=size)
        image = turned(decode_rgb(io.BytesIO(self.read()), (1.0, 1.0, 1.0)), frame)
        pixels = np.array(shrunk(image, side, Image.Resampling.LANCZOS))
        height, width, _ = pixels.shape
        intrinsics = frame.at_size((height, width))
        if frame.lens is not None:
            pixels = undistorted(pixels, intrinsics, frame.lens)
        return pixels, np.array(intrinsics)


def shrunk(image: Image.Image, side: int, filter: Image.Resampling) -> Image.Image:
    """Return the image with `side` pixels on its longer side, or as it is if that is shorter."""
    scale = min(1.0, side / max(image.size))
    width, height = (max(1, round(extent * scale)) for extent in image.size)
    return image.resize((width, height), filter)


@dataclass(frozen=True)
class Candidate:
    """A scene to check. scene: its name in indices. photos: raises ValueError or OSError.

    missing: names of listed images that do not exist and are none of `photos`; raises the same.
    """

    name: str
    scene: str
    kind: str
    photos: Callable[[], Sequence[Photo]]
    split: str = ""
    missing: Callable[[], Sequence[str]] = tuple

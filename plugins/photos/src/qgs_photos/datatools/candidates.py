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
from qgs_photos.datatools.conventions import Convention


@dataclass(frozen=True)
class Photo:
    """A listed photo, what reads its bytes, and whether it and its mask exist."""

    listed: PhotoFrame
    read: Callable[[], bytes]
    exists: bool = True
    mask_exists: bool = True
    read_mask: Callable[[], np.ndarray | None] | None = None  # a mask that is in no file, (H, W)

    def picture(self, size: Size | None, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Pinhole RGB, `side` pixels long at most, and its intrinsics (4,). Raises OSError."""
        frame = self.listed if self.listed.size else replace(self.listed, size=size)
        image = turned(decode_rgb(io.BytesIO(self.read()), (1.0, 1.0, 1.0)), frame)
        scale = min(1.0, side / max(image.size))
        width, height = (max(1, round(extent * scale)) for extent in image.size)
        pixels = np.array(image.resize((width, height), Image.Resampling.LANCZOS))
        intrinsics = frame.at_size((height, width))
        if frame.lens is not None:
            pixels = undistorted(pixels, intrinsics, frame.lens)
        return pixels, np.array(intrinsics)


@dataclass(frozen=True)
class Candidate:
    """A scene to check. scene: its name in indices. photos: raises ValueError or OSError.

    missing: names of listed images that do not exist and are none of `photos`; raises the same.
    """

    name: str
    scene: str
    kind: str
    convention: Convention
    photos: Callable[[], Sequence[Photo]]
    split: str = ""
    missing: Callable[[], Sequence[str]] = tuple

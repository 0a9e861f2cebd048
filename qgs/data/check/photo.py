"""One photo of a data set under test: what is listed, and its bytes."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from qgs.data.check.conventions import Convention
from qgs.data.frames import PhotoFrame, Size
from qgs.data.images import decode_rgb
from qgs.data.undistortion import undistorted


@dataclass(frozen=True)
class Photo:
    """listed: as the listing says, with the faults that parsing found. read: the file's bytes.

    exists, mask_exists: whether the files that are listed are there.
    """

    listed: PhotoFrame
    read: Callable[[], bytes]
    exists: bool = True
    mask_exists: bool = True

    def picture(self, size: Size | None, side: int) -> tuple[Image.Image, np.ndarray]:
        """The photo as a pinhole camera took it, RGB, with `side` pixels on its longer side.

        size: (H, W) of the file, which intrinsics go with where none is listed. Also the intrinsics
        (4,) in pixels of the picture. Raises OSError for a file that cannot be decoded.
        """
        frame = self.listed if self.listed.size else replace(self.listed, size=size)
        image = decode_rgb(io.BytesIO(self.read()), (1.0, 1.0, 1.0))
        scale = min(1.0, side / max(image.size))
        width, height = (max(1, round(extent * scale)) for extent in image.size)
        image = image.resize((width, height), Image.Resampling.LANCZOS)
        intrinsics = frame.at_size((height, width))
        if frame.lens is not None:
            image = Image.fromarray(undistorted(np.array(image), intrinsics, frame.lens))
        return image, np.array(intrinsics)


@dataclass(frozen=True)
class Candidate:
    """A scene to check, opened by `photos`, which raises ValueError or OSError for a bad listing.

    name: as told; scene: as evaluation indices name it. kind: its format. split: train or test,
    empty where the format knows no such folders.
    """

    name: str
    scene: str
    kind: str
    convention: Convention
    photos: Callable[[], Sequence[Photo]]
    split: str = ""

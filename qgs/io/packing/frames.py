"""Frames as chunks hold them: pinhole photos, JPEG or PNG, with their masks."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from PIL import Image

from qgs.contracts import Scene
from qgs.data.encoded import EncodedFrame, EncodedScene
from qgs.data.images import decode_gray, decode_rgb
from qgs.data.undistortion import undistorted

_KEPT_FORMATS = {"JPEG", "MPO", "PNG"}  # MPO: a JPEG with further pictures behind it


@dataclass(frozen=True)
class Encoding:
    """How images are written that cannot stay as they are.

    resized: whether all are written at the size that their source delivers; else they keep their
    own. jpeg: quality; None for PNG, which loses nothing.
    """

    resized: bool = False
    jpeg: int | None = None

    @property
    def format(self) -> Literal["JPEG", "PNG"]:
        """The format of images that are written anew."""
        return "PNG" if self.jpeg is None else "JPEG"

    def image(self, pixels: np.ndarray) -> bytes:
        """(H, W, 3) uint8 as the bytes of a file."""
        file = io.BytesIO()
        options = {} if self.jpeg is None else {"quality": self.jpeg, "subsampling": 0}
        Image.fromarray(pixels).save(file, self.format, **options)
        return file.getvalue()


def packed_frames(scene: Scene, encoding: Encoding) -> Iterator[tuple[EncodedFrame, bool]]:
    """The frames of a scene in order, and whether each keeps its original bytes.

    Every image is decoded, so that none is packed that cannot be read. Raises as the scene does.
    """
    if isinstance(scene, EncodedScene) and not encoding.resized:
        for index in range(len(scene)):
            yield _stored(scene, index, encoding)
        return
    for index in range(len(scene)):
        yield _delivered(scene, index, encoding), False


def _stored(scene: EncodedScene, index: int, encoding: Encoding) -> tuple[EncodedFrame, bool]:
    frame = scene.encoded(index)
    place = f"scene {scene.name!r}, frame {index} ({frame.name})"
    try:
        pixels = np.array(decode_rgb(io.BytesIO(frame.data), frame.background))
        mask = None if frame.mask is None else np.array(decode_gray(io.BytesIO(frame.mask)))
    except OSError as error:
        raise ValueError(
            f"{place} cannot be read as an image ({error}): replace the file, or leave the scene "
            "out"
        ) from error
    if frame.lens is None and _stays(frame.data):
        return frame, True
    if frame.lens is not None:
        pixels = undistorted(pixels, frame.intrinsics, frame.lens)
        mask = None if mask is None else undistorted(mask, frame.intrinsics, frame.lens)
    data = encoding.image(pixels)
    return replace(frame, data=data, lens=None, mask=None if mask is None else _png(mask)), False


def _stays(data: bytes) -> bool:
    """Whether every reader of chunks gets three channels out of an image file."""
    with Image.open(io.BytesIO(data)) as image:
        plain = image.mode == "RGB" and not image.has_transparency_data
        return plain and image.format in _KEPT_FORMATS


def _delivered(scene: Scene, index: int, encoding: Encoding) -> EncodedFrame:
    cameras, masks = scene.cameras[index], scene.masks([index])
    fx, fy, cx, cy = cameras.intrinsics.double().tolist()
    pixels = scene.images([index])[0].permute(1, 2, 0).mul(255).round().byte().numpy()
    mask = None if masks is None else _png(masks[0, 0].mul(255).round().byte().numpy())
    return EncodedFrame(
        name=scene.frame_name(index),
        data=encoding.image(np.ascontiguousarray(pixels)),
        c2w=cameras.c2w.double().numpy(),
        intrinsics=(fx, fy, cx, cy),
        size=cameras.size,
        mask=mask,
    )


def _png(mask: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(mask).save(file, "PNG")
    return file.getvalue()

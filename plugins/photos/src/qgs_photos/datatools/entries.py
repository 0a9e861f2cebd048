"""Convert a scene to the entry of a chunk; image files are copied unchanged where possible."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from qgs.contracts import Scene
from qgs.data.images import CropResize, decode_rgb
from qgs.data.photos.source import PhotoScene, turned, whole_mask
from qgs.drawing.images import png_bytes, rgb_picture
from qgs.paths import read_file
from qgs_photos.datasets.chunks import ChunkScene
from qgs_photos.datasets.encoded import EncodedFrame, as_intrinsics

ChunkEntry: TypeAlias = dict[str, Any]

# MPO: a JPEG with further pictures behind it.
_KEPT_FORMATS = {"JPEG", "MPO", "PNG"}


@dataclass(frozen=True)
class Encoding:
    """Settings for images that are encoded again.

    resized: encode all images again, in the size in which the source returns them; False copies
    files unchanged where possible. jpeg: quality of JPEG files, from 1 to 100; None writes PNG.
    """

    resized: bool = False
    jpeg: int | None = None

    def image(self, pixels: np.ndarray) -> bytes:
        """Encode pixels (H, W, 3), uint8, as the bytes of a JPEG or PNG file."""
        if self.jpeg is None:
            return png_bytes(pixels)
        file = io.BytesIO()
        # by default Pillow would halve the resolution of colours
        Image.fromarray(pixels).save(file, "JPEG", quality=self.jpeg, subsampling=0)
        return file.getvalue()


def encoded_frames(scene: Scene, encoding: Encoding) -> Iterator[tuple[EncodedFrame, bool]]:
    """Yield each frame of a scene with its image file, and whether the file is copied unchanged.

    Raises ValueError for an image that cannot be decoded, and the errors of reading the scene.
    """
    for index in range(len(scene)):
        if isinstance(scene, PhotoScene | ChunkScene) and not encoding.resized:
            yield _stored(scene, index, encoding)
        else:
            yield _delivered(scene, index, encoding), False


def _encoded_photo(scene: PhotoScene, frame: int) -> EncodedFrame:
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


def _stored(
    scene: PhotoScene | ChunkScene, index: int, encoding: Encoding
) -> tuple[EncodedFrame, bool]:
    photos = isinstance(scene, PhotoScene)
    frame = _encoded_photo(scene, index) if photos else scene.encoded(index)
    try:
        pixels = np.array(decode_rgb(io.BytesIO(frame.data), scene.config.background))
    except OSError as error:
        raise ValueError(
            f"scene {scene.name!r}, frame {index} ({frame.name}) cannot be read as an image "
            f"({error}): replace the file, or leave the scene out"
        ) from error
    if frame.lens is not None:
        return _straightened(frame, pixels, encoding), False
    with Image.open(io.BytesIO(frame.data)) as image:
        # every reader gets three channels out of it
        plain = image.mode == "RGB" and not image.has_transparency_data
        if plain and image.format in _KEPT_FORMATS:
            return frame, True
    return replace(frame, data=encoding.image(pixels)), False


def _straightened(frame: EncodedFrame, pixels: np.ndarray, encoding: Encoding) -> EncodedFrame:
    """Undistort a frame as a pinhole camera would show it, and crop the black border."""
    assert frame.lens is not None
    lens = frame.lens
    zoom = lens.whole_zoom(frame.intrinsics, frame.size, frame.size)
    crop = CropResize(frame.size, frame.size, zoom)

    def straight(image: np.ndarray) -> np.ndarray:
        return crop.image(Image.fromarray(lens.undistorted(image, frame.intrinsics)))

    own = torch.tensor(frame.intrinsics, dtype=torch.float64)
    return replace(
        frame,
        data=encoding.image(straight(pixels)),
        intrinsics=as_intrinsics(crop.intrinsics(own)),
        lens=None,
        mask=None if frame.mask is None else straight(frame.mask),
    )


def _delivered(scene: Scene, index: int, encoding: Encoding) -> EncodedFrame:
    cameras = scene.cameras[index]
    masks = scene.masks([index])
    return EncodedFrame(
        name=scene.frame_name(index),
        data=encoding.image(rgb_picture(scene.images([index])[0])),
        c2w=cameras.c2w.double().numpy(),
        intrinsics=as_intrinsics(cameras.intrinsics),
        size=cameras.size,
        mask=None if masks is None else rgb_picture(masks[0])[..., 0],
    )


def chunk_entry(
    key: str, frames: Sequence[EncodedFrame], held_out: Sequence[int], times: Tensor | None
) -> ChunkEntry:
    """Return the entry of a scene in a chunk; `qgs_photos.datasets.chunk_files` explains its keys.

    key: name of the scene. held_out: indices of frames that are left out of training. times: time
    of each of the V frames, (V,); None for a scene that does not move.
    """
    names = [frame.name for frame in frames]
    # 19 digits may be more than an int64 holds
    stamps = all(name.isascii() and name.isdigit() and len(name) < 19 for name in names)
    entry = {
        "key": key,
        "url": "",
        "timestamps": torch.tensor(
            [int(name) for name in (names if stamps else range(len(names)))]
        ),
        "cameras": torch.from_numpy(np.stack([_camera(frame) for frame in frames])),
        "images": [_bytes(frame.data) for frame in frames],
        "names": names,
        "sizes": torch.tensor([frame.size for frame in frames], dtype=torch.int32),
    }
    if any(frame.mask is not None for frame in frames):
        entry["masks"] = [
            _bytes(b"" if frame.mask is None else png_bytes(frame.mask)) for frame in frames
        ]
    if held_out:
        entry["held_out"] = torch.tensor(list(held_out))
    if times is not None:
        entry["times"] = times.double().clone()
    return entry


def _bytes(data: bytes) -> Tensor:
    # a copy: torch wants memory that may be written to
    return torch.from_numpy(np.frombuffer(data, np.uint8).copy())


def _camera(frame: EncodedFrame) -> np.ndarray:
    """Return a camera as (18,) float32: fx, fy, cx, cy, two zeros, three rows of world-to-camera.

    fx and cx are divided by the width of the image, fy and cy by its height.
    """
    height, width = frame.size
    fx, fy, cx, cy = frame.intrinsics
    w2c = np.linalg.inv(frame.c2w)[:3].flatten()
    values = [fx / width, fy / height, cx / width, cy / height, 0.0, 0.0, *w2c]
    return np.array(values, np.float32)

"""Convert a scene to the entry of a chunk; image files are copied unchanged where possible."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from qgs.contracts import Scene
from qgs.data.images import CropResize, decode_rgb
from qgs.data.photos.reader import PhotoFrame
from qgs.data.photos.source import PhotoScene, turned, whole_mask
from qgs.drawing.images import png_bytes
from qgs.paths import read_file
from qgs_photos.datasets.chunks import ChunkScene
from qgs_photos.datatools.candidates import chunk_photo, source_photo
from qgs_photos.datatools.photos import Photo

ChunkEntry = dict[str, Any]

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


class EncodedFrame(NamedTuple):
    """A photo as an encoded file.

    listed: its name, camera and size. data: bytes of the image file. mask: (H, W) uint8; None for a
    photo without a mask. kept: whether the file is copied unchanged.
    """

    listed: PhotoFrame
    data: bytes
    mask: np.ndarray | None
    kept: bool = False


def encoded_frames(scene: Scene, encoding: Encoding) -> Iterator[EncodedFrame]:
    """Yield each frame of a scene with its image file.

    Raises ValueError for an image that cannot be decoded, and the errors of reading the scene.
    """
    for index in range(len(scene)):
        if isinstance(scene, PhotoScene | ChunkScene) and not encoding.resized:
            yield _stored(scene, index, encoding)
        else:
            yield _read(source_photo(scene, index, encoding.image))


def _read(photo: Photo) -> EncodedFrame:
    return EncodedFrame(photo.listed, photo.read(), photo.maps["mask"]())


def _stored(scene: PhotoScene | ChunkScene, index: int, encoding: Encoding) -> EncodedFrame:
    """Return a frame with its file as stored, if all readers show it alike; else encoded again."""
    size = scene.stored_size(index)
    if isinstance(scene, PhotoScene):
        photo = scene.photos[index]
        data = read_file(photo.path)
        # pixels are stored again only where EXIF turns them
        if photo.turns:
            file = io.BytesIO()
            turned(decode_rgb(io.BytesIO(data), scene.config.background), photo).save(file, "png")
            data = file.getvalue()
        listed = replace(photo, intrinsics=photo.at_size(size), size=size)
        mask = photo.mask and np.array(turned(whole_mask(photo), photo))
        frame = EncodedFrame(listed, data, mask)
    else:
        frame = _read(chunk_photo(scene.record, index, size))
    try:
        pixels = np.array(decode_rgb(io.BytesIO(frame.data), scene.config.background))
    except OSError as error:
        raise ValueError(
            f"scene {scene.name!r}, frame {index} ({frame.listed.name}) cannot be read as an image "
            f"({error}): replace the file, or leave the scene out"
        ) from error
    if frame.listed.lens is not None:
        return _straightened(frame, pixels, encoding)
    with Image.open(io.BytesIO(frame.data)) as image:
        # every reader gets three channels out of it
        plain = image.mode == "RGB" and not image.has_transparency_data
        if plain and image.format in _KEPT_FORMATS:
            return frame._replace(kept=True)
    return frame._replace(data=encoding.image(pixels))


def _straightened(frame: EncodedFrame, pixels: np.ndarray, encoding: Encoding) -> EncodedFrame:
    """Undistort a frame as a pinhole camera would show it, and crop the black border."""
    own = frame.listed
    assert own.lens is not None
    lens = own.lens
    size = (pixels.shape[0], pixels.shape[1])
    crop = CropResize(size, size, lens.whole_zoom(own.intrinsics, size, size))

    def straight(image: np.ndarray) -> np.ndarray:
        return crop.image(Image.fromarray(lens.undistorted(image, own.intrinsics)))

    given = torch.tensor(own.intrinsics, dtype=torch.float64)
    fx, fy, cx, cy = crop.intrinsics(given).tolist()
    return EncodedFrame(
        replace(own, intrinsics=(fx, fy, cx, cy), lens=None),
        encoding.image(straight(pixels)),
        None if frame.mask is None else straight(frame.mask),
    )


def chunk_entry(
    key: str, frames: Sequence[EncodedFrame], held_out: Sequence[int], times: Tensor | None
) -> ChunkEntry:
    """Return the entry of a scene in a chunk; `qgs_photos.datasets.chunk_files` explains its keys.

    key: name of the scene. held_out: indices of frames that are left out of training. times: time
    of each of the V frames, (V,); None for a scene that does not move.
    """
    names = [frame.listed.name for frame in frames]
    # 19 digits may be more than an int64 holds
    stamps = all(name.isascii() and name.isdigit() and len(name) < 19 for name in names)
    entry = {
        "key": key,
        "url": "",
        "timestamps": torch.tensor([*map(int, names if stamps else range(len(names)))]),
        "cameras": torch.from_numpy(np.stack([_camera(frame) for frame in frames])),
        "images": [_bytes(frame.data) for frame in frames],
        "names": names,
        "sizes": torch.tensor([frame.listed.size for frame in frames], dtype=torch.int32),
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
    return torch.tensor(np.frombuffer(data, np.uint8))


def _camera(frame: EncodedFrame) -> np.ndarray:
    """Return a camera as (18,) float32: fx, fy, cx, cy, two zeros, three rows of world-to-camera.

    fx and cx are divided by the width of the image, fy and cy by its height.
    """
    w2c = np.linalg.inv(frame.listed.c2w)[:3].flatten()
    return np.array([*frame.listed.at_size((1, 1)), 0.0, 0.0, *w2c], np.float32)

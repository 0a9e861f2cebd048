"""One scene of a chunk: parsing tells what it is, judging whether it can be used."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from qgs.data.lazy import a_type
from qgs.data.photos.frames import Fault, intrinsics_faults, pose_faults

_RIGID = 0.9e-3  # of rotations against orthonormality, below what `pose_faults` tells
_IN_PIXELS = 50.0  # a focal length above is no multiple of the image's width or height
_DIVIDED_TWICE = 0.02  # a focal length below is an angle of view of more than 175 degrees
_HEADER = 4096  # bytes that nearly always hold an image's size
_AGAIN = "pack the data set again with `qgs data pack`, or remove the scene from index.json"


@dataclass(frozen=True)
class Record:
    """A scene as a chunk holds it; nothing is decoded.

    where: file and key, for messages. cameras: (V, 18) float32. images: V uint8 tensors with the
    bytes of image files. names: V names of frames. sizes: (V, 2) height and width, None where the
    chunk does not say. masks: V uint8 tensors, empty for a frame without one; None without masks.
    held_out: frames that training is not to see.
    """

    where: str
    key: str
    cameras: Tensor
    images: Sequence[Tensor]
    names: Sequence[str]
    sizes: Tensor | None
    masks: Sequence[Tensor] | None
    held_out: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.images)

    def place(self, frame: int) -> str:
        """File, key, frame number and name, for messages."""
        return f"{self.where}, frame {frame} ({self.names[frame]})"

    @cached_property
    def w2c(self) -> Tensor:
        """(V, 4, 4) float64 world-to-camera, OpenCV axes, as stored."""
        matrix = torch.eye(4, dtype=torch.float64).repeat(len(self), 1, 1)
        matrix[:, :3] = self.cameras[:, 6:].double().reshape(-1, 3, 4)
        return matrix

    @cached_property
    def image_sizes(self) -> list[tuple[int, int]]:
        """(H, W) of every image: as the chunk says, else all as the first image's header says.

        Raises ValueError when that is no readable image.
        """
        if self.sizes is not None:
            return [(int(height), int(width)) for height, width in self.sizes.tolist()]
        return [self.stored_size(0)] * len(self)

    def stored_size(self, frame: int) -> tuple[int, int]:
        """(H, W) that the header of an image tells. Raises ValueError for no readable image."""
        data = self.images[frame]
        for part in (data[:_HEADER], data):
            try:
                with Image.open(io.BytesIO(part.numpy().tobytes())) as image:
                    return image.height, image.width
            except (OSError, SyntaxError, ValueError):
                continue
        raise ValueError(f"{self.place(frame)}: the bytes are no readable image: {_AGAIN}")


def parse_record(where: str, data: Any) -> Record:
    """The scene that `data`, an entry of a chunk in the file `where`, describes.

    Raises ValueError, naming key and entry, where its structure is not that of the format; numbers
    are not judged.
    """
    if not isinstance(data, Mapping) or not isinstance(data.get("key"), str):
        raise ValueError(
            f"{where} holds {_kind(data)}, expected a mapping with 'key', 'cameras' and 'images': "
            "is it a chunk of RealEstate10K's format?"
        )
    where = f"{where}: scene {data['key']!r}"
    images = _encoded(where, "images", data.get("images"))
    if not images:
        raise ValueError(f"{where} has no frames: {_AGAIN}")
    cameras = _tensor(where, "cameras", data.get("cameras"), (len(images), 18))
    if not cameras.is_floating_point():
        raise ValueError(f"{where}: 'cameras' are {cameras.dtype}, expected float32: {_AGAIN}")
    sizes, masks = data.get("sizes"), data.get("masks")
    if sizes is not None:
        sizes = _tensor(where, "sizes", sizes, (len(images), 2))
    if masks is not None:
        masks = _as_many(where, "masks", _encoded(where, "masks", masks), len(images))
    names = _names(where, data, len(images))
    held_out = _frames(where, data.get("held_out"), len(images))
    return Record(where, data["key"], cameras, images, names, sizes, masks, held_out)


def _kind(data: Any) -> str:
    if isinstance(data, Mapping):
        return f"a mapping with the keys {', '.join(map(repr, list(data)[:6])) or 'none'}"
    return a_type(data)


def _tensor(where: str, name: str, data: Any, shape: tuple[int, ...]) -> Tensor:
    if isinstance(data, np.ndarray):
        data = torch.from_numpy(data)
    if not isinstance(data, Tensor) or tuple(data.shape) != shape:
        found = list(data.shape) if isinstance(data, Tensor) else _kind(data)
        raise ValueError(
            f"{where}: {name!r} must be a tensor of shape {list(shape)}, as there are {shape[0]} "
            f"images, got {found}: {_AGAIN}"
        )
    return data


def _encoded(where: str, name: str, data: Any) -> Sequence[Tensor]:
    valid = isinstance(data, list | tuple) and all(
        isinstance(item, Tensor) and item.dtype == torch.uint8 and item.ndim == 1 for item in data
    )
    if not valid:
        raise ValueError(
            f"{where}: {name!r} must be a list of one-dimensional uint8 tensors with the bytes of "
            f"image files, got {_kind(data)}: {_AGAIN}"
        )
    return data


def _as_many(where: str, name: str, data: Sequence[Any], count: int) -> Sequence[Any]:
    if len(data) != count:
        raise ValueError(f"{where}: {len(data)} {name} for {count} images: {_AGAIN}")
    return data


def _names(where: str, data: Mapping[str, Any], count: int) -> Sequence[str]:
    """The writer's names, else time stamps, else numbers."""
    if isinstance(data.get("names"), list):
        return [str(name) for name in _as_many(where, "names", data["names"], count)]
    stamps = data.get("timestamps")
    if isinstance(stamps, Tensor) and stamps.numel() == count:
        return [str(stamp) for stamp in stamps.flatten().tolist()]
    return [str(frame) for frame in range(count)]


def _frames(where: str, data: Any, count: int) -> tuple[int, ...]:
    if data is None:
        return ()
    frames = data.tolist() if isinstance(data, Tensor) else list(data)
    if not all(isinstance(frame, int) and 0 <= frame < count for frame in frames):
        raise ValueError(
            f"{where}: 'held_out' must list frames from 0 to {count - 1}, got {frames}: {_AGAIN}"
        )
    return tuple(frames)


def judge_record(record: Record) -> None:
    """Raise ValueError for the first camera with a fatal fault, naming its frame."""
    if _sound(record):
        return
    for frame in range(len(record)):
        for fault in camera_faults(record, frame):
            if fault.fatal:
                raise ValueError(f"{record.place(frame)}: {fault}")


def _sound(record: Record) -> bool:
    """Whether no camera can have a fatal fault, told for all frames at once."""
    rotation = record.w2c[:, :3, :3]
    error = rotation @ rotation.mT - torch.eye(3, dtype=torch.float64)
    focal = record.cameras[:, :2]
    return bool(
        torch.isfinite(record.cameras).all()
        and error.abs().max() < _RIGID
        and torch.linalg.det(rotation).min() > 0
        and focal.min() > 0
        and focal.max() < _IN_PIXELS
    )


def camera_faults(record: Record, frame: int) -> Iterator[Fault]:
    """What is wrong with the camera of a frame."""
    yield from pose_faults(record.w2c[frame].numpy())
    of_unit = list(unit_faults(record, frame))
    yield from of_unit
    if not of_unit:
        height, width = record.image_sizes[frame]
        fx, fy, cx, cy = record.cameras[frame, :4].tolist()
        in_pixels = (fx * width, fy * height, cx * width, cy * height)
        yield from intrinsics_faults(in_pixels, (height, width))


def unit_faults(record: Record, frame: int) -> Iterator[Fault]:
    """What is wrong with the unit of a frame's intrinsics, fractions of the image's sides."""
    values = record.cameras[frame, :4].tolist()
    focal = max(values[:2])
    said = ", ".join(f"{value:.6g}" for value in values)
    if focal >= _IN_PIXELS:
        yield Fault(
            f"the intrinsics ({said}) look like pixels",
            "chunks hold fx and cx divided by the image's width, fy and cy by its height",
        )
    elif 0 < focal < _DIVIDED_TWICE:
        yield Fault(
            f"the intrinsics ({said}) look divided twice",
            "chunks hold fx and cx divided once by the image's width, fy and cy by its height",
        )

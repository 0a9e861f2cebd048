"""Scenes in the form of a chunk's entries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from qgs.data.encoded import EncodedFrame

ChunkEntry: TypeAlias = dict[str, Any]


def chunk_entry(key: str, frames: Sequence[EncodedFrame], held_out: Sequence[int]) -> ChunkEntry:
    """The entry of a scene; see `qgs.data.chunks` for its keys."""
    entry = {
        "key": key,
        "url": "",
        "timestamps": _timestamps([frame.name for frame in frames]),
        "cameras": torch.from_numpy(np.stack([_camera(frame) for frame in frames])),
        "images": [_bytes(frame.data) for frame in frames],
        "names": [frame.name for frame in frames],
        "sizes": torch.tensor([frame.size for frame in frames], dtype=torch.int32),
    }
    if any(frame.mask is not None for frame in frames):
        entry["masks"] = [_bytes(frame.mask or b"") for frame in frames]
    if held_out:
        entry["held_out"] = torch.tensor(list(held_out), dtype=torch.int64)
    return entry


def stored_bytes(entry: ChunkEntry) -> int:
    """What an entry adds to the size of its chunk, but for the container's own bytes."""
    return sum(data.nbytes for key in ("images", "masks") for data in entry.get(key, ()))


def _bytes(data: bytes) -> Tensor:
    return torch.from_numpy(np.frombuffer(data, np.uint8).copy())


def _camera(frame: EncodedFrame) -> np.ndarray:
    """(18,) float32: normalised intrinsics, two zeros, rows of the world-to-camera matrix."""
    height, width = frame.size
    fx, fy, cx, cy = frame.intrinsics
    w2c = np.linalg.inv(frame.c2w)[:3].flatten()
    values = [fx / width, fy / height, cx / width, cy / height, 0.0, 0.0, *w2c]
    return np.array(values, np.float32)


def _timestamps(names: Sequence[str]) -> Tensor:
    """The frames' names where all are whole numbers, as time stamps are; else their order."""
    numbers = names if all(_is_stamp(name) for name in names) else range(len(names))
    return torch.tensor([int(number) for number in numbers], dtype=torch.int64)


def _is_stamp(name: str) -> bool:
    return name.isascii() and name.isdigit() and len(name) < 19

"""Read and check chunk files in RealEstate10K's format, and list the scenes of a folder.

pixelSplat published RealEstate10K and ACID in this format; DepthSplat published DL3DV in it. In
the folder of a data set, train/index.json and test/index.json map the key of a scene to a chunk
file such as 000000.torch. A chunk file is a list with a mapping for each scene of V frames:

- `key`: name of the scene. `url`: address of its video. `timestamps`: the frames' times in the
  video, (V,).
- `cameras`: (V, 18) float32: fx, fy, cx, cy divided by the image's width and height, two unused
  numbers, the rows of the 3 x 4 OpenCV world-to-camera matrix.
- `images`: a list of V uint8 tensors with the bytes of JPEG or PNG files.

`qgs data pack` adds keys that other readers ignore:
- `names`: V names of the frames. `sizes`: (V, 2), height and width of every image.
- `masks`: a list of V uint8 tensors with the bytes of PNG files, empty for frames without a mask.
- `held_out`: indices of frames that training must not use. `times`: (V,) float64, if times exist.
"""

import io
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor
from upath import UPath

from qgs.data.images import decode_mask, image_size
from qgs.data.photos.reader import (
    LARGEST_SIDE,
    FrameProblem,
    Intrinsics,
    Size,
    intrinsics_problems,
    pose_problems,
    size_problems,
)
from qgs.paths import is_local, listing, open_file, read_json
from qgs.wording import listed, name_shown, warn_once

INDEX = "index.json"
SUFFIX = ".torch"
# Of rotations against orthonormality, below what `pose_problems` refuses.
_RIGID = 0.9e-3
# A focal length above is no multiple of the image's width or height.
_IN_PIXELS = 50.0
# A focal length below is an angle of view of more than 175 degrees.
_DIVIDED_TWICE = 0.02


@dataclass(frozen=True)
class Record:
    """A scene of V frames as stored in a chunk file; the module's docstring gives the formats.

    where: names of the file and the scene, for error messages. cameras: (V, 18). images,
    masks: bytes of image files. names: names of the frames, or their time stamps if the file has no
    names. sizes: (V, 2), height and width of the images. held_out: indices of frames that training
    must not use. times: (V,), times of the frames. sizes, masks and times are None if the file does
    not have them.
    """

    where: str
    cameras: Tensor
    images: Sequence[Tensor]
    names: Sequence[str]
    sizes: Tensor | None
    masks: Sequence[Tensor] | None
    held_out: tuple[int, ...]
    times: Tensor | None

    def __len__(self) -> int:
        return len(self.images)

    def place(self, frame: int) -> str:
        """Return text that names a frame in messages: its chunk, its scene, its number and name."""
        return f"{self.where}, frame {frame} ({self.names[frame]})"

    @cached_property
    def w2c(self) -> Tensor:
        """World-to-camera matrices (V, 4, 4) as stored, float64, OpenCV axes."""
        matrix = torch.eye(4, dtype=torch.float64).repeat(len(self), 1, 1)
        matrix[:, :3] = self.cameras[:, 6:].double().reshape(-1, 3, 4)
        return matrix

    @cached_property
    def image_sizes(self) -> list[Size]:
        """Sizes (H, W) of the images as listed; without a list, all have the first image's size."""
        if self.sizes is not None:
            return [(int(height), int(width)) for height, width in self.sizes.tolist()]
        return [self.stored_size(0)] * len(self)

    def stored_size(self, frame: int) -> Size:
        """Return (H, W) from the header of an image. Raises ValueError if it cannot be read."""
        try:
            return image_size(io.BytesIO(self.images[frame].numpy().tobytes()))
        except OSError as error:
            raise ValueError(
                f"{self.place(frame)}: the image cannot be read ({error}): pack the data set "
                "again with `qgs data pack`, or remove the scene from index.json"
            ) from error

    def intrinsics(self, frame: int, size: Size) -> Intrinsics:
        """Return fx, fy, cx, cy of a frame, in pixels of an image of `size` (H, W)."""
        fx, fy, cx, cy = self.cameras[frame, :4].double().tolist()
        return fx * size[1], fy * size[0], cx * size[1], cy * size[0]

    def mask(self, frame: int) -> np.ndarray | None:
        """Decode the mask of a frame, (H, W) uint8; None if the frame has no mask.

        Raises ValueError for a mask that cannot be read or has another size than its image.
        """
        data = None if self.masks is None else self.masks[frame].numpy().tobytes()
        if not data:
            return None
        try:
            mask = decode_mask(io.BytesIO(data))
        except OSError as error:
            fix = "pack the chunk again, or remove the scene from index.json"
            raise ValueError(
                f"the mask of {self.place(frame)} cannot be read ({error}): {fix}"
            ) from error
        for problem in size_problems(mask.shape[:2], self.image_sizes[frame]):
            raise ValueError(f"the mask of {self.place(frame)} has a wrong size: {problem}")
        return mask

    def require_usable(self) -> None:
        """Raise ValueError that names the first frame with an invalid pose or intrinsics."""
        rotation = self.w2c[:, :3, :3]
        error = rotation @ rotation.mT - torch.eye(3, dtype=torch.float64)
        focal = self.cameras[:, :2]
        usable = (
            torch.isfinite(self.cameras).all()
            and error.abs().max() < _RIGID
            and torch.linalg.det(rotation).min() > 0
            and focal.min() > 0
            and focal.max() < _IN_PIXELS
        )
        # checking all frames at once first is ten times as fast as one by one
        for frame in () if usable else range(len(self)):
            size = self.image_sizes[frame]
            problems = (
                *pose_problems(self.w2c[frame].numpy()),
                *self.unit_problems(frame),
                *intrinsics_problems(self.intrinsics(frame, size), size),
            )
            for problem in problems:
                raise ValueError(f"{self.place(frame)}: {problem}")

    def unit_problems(self, frame: int) -> Iterator[FrameProblem]:
        """Yield a problem if a frame's intrinsics were not divided by the image's size once."""
        values = self.cameras[frame, :4].tolist()
        focal = max(values[:2])
        divided_twice = 0 < focal < _DIVIDED_TWICE
        if divided_twice or focal >= _IN_PIXELS:
            numbers = ", ".join(f"{value:.6g}" for value in values)
            unit = "divided twice" if divided_twice else "like pixels"
            yield FrameProblem(
                f"the intrinsics ({numbers}) look {unit}",
                "chunks hold fx and cx divided once by the image's width, fy and cy by its height",
            )


def parse_record(file: str, data: Mapping[str, Any]) -> Record:
    """Return the scene in an entry `data` of a chunk `file`, which has a key.

    Raises ValueError if it is invalid.
    """
    where = f"{file}: scene {data['key']!r}"
    for name in ("cameras", "images", "sizes", "masks", "timestamps", "held_out", "times"):
        value = data.get(name)
        for item in value if isinstance(value, list | tuple) else [value]:
            plain = not isinstance(item, Tensor) or _is_plain(item)
            _expect(plain, where, f"{name!r} holds a tensor that does not store all its numbers")
    images = _files(where, "images", data.get("images"))
    count = len(images)
    _expect(count > 0, where, "there are no frames")
    cameras = _tensor(where, "cameras", data.get("cameras"), (count, 18))
    _expect(cameras.is_floating_point(), where, f"'cameras' are {cameras.dtype}, expected float32")
    sizes, masks, names, times = (data.get(key) for key in ("sizes", "masks", "names", "times"))
    if sizes is not None:
        sizes = _tensor(where, "sizes", sizes, (count, 2))
        fits = bool(((sizes >= 1) & (sizes <= LARGEST_SIDE)).all())
        _expect(fits, where, f"'sizes' must be pixels from 1 to {LARGEST_SIDE}")
    if masks is not None:
        masks = _files(where, "masks", masks)
        _expect(len(masks) == count, where, f"{len(masks)} masks for {count} images")
    # RealEstate10K's: the time of a frame in its video
    if names is None:
        stamps = data.get("timestamps")
        names = stamps.flatten().tolist() if isinstance(stamps, Tensor) else range(count)
    fits = isinstance(names, list | range) and len(names) == count
    _expect(fits, where, f"'names' or 'timestamps' must have {count} entries, one for each image")
    held_out = data.get("held_out", ())
    held_out = held_out.flatten().tolist() if isinstance(held_out, Tensor) else held_out
    fits = isinstance(held_out, list | tuple) and {*held_out} <= {*range(count)}
    _expect(fits, where, f"'held_out' must list frames from 0 to {count - 1}")
    if times is not None:
        times = _tensor(where, "times", times, (count,)).to(torch.float64, copy=True)
        _expect(bool(times.isfinite().all()), where, "'times' must be finite numbers")
    names = [str(name) for name in names]
    return Record(where, cameras, images, names, sizes, masks, tuple(held_out), times)


def _expect(valid: bool, where: str, reason: str) -> None:
    if not valid:
        fix = "pack the data set again with `qgs data pack`, or remove the scene from index.json"
        raise ValueError(f"{where}: {reason}: {fix}")


def _is_plain(data: Tensor) -> bool:
    """Return whether a tensor is dense, on the CPU, and stores every number.

    A tensor made by `expand` stores fewer numbers than it has; a copy of it could fill the memory.
    """
    strided = data.layout == torch.strided and data.device.type == "cpu"
    if not strided or data.is_quantized or data.is_nested:
        return False
    return data.nbytes <= data.untyped_storage().nbytes()


def _tensor(where: str, name: str, data: Any, shape: tuple[int, ...]) -> Tensor:
    found = list(data.shape) if isinstance(data, Tensor) else type(data).__name__
    wanted = f"a tensor of shape {list(shape)}, as there are {shape[0]} images"
    _expect(found == list(shape), where, f"{name!r} must be {wanted}, got {found}")
    assert isinstance(data, Tensor)
    return data.detach()


def _files(where: str, name: str, data: Any) -> Sequence[Tensor]:
    valid = isinstance(data, list | tuple) and all(
        isinstance(item, Tensor) and item.dtype == torch.uint8 and item.ndim == 1 for item in data
    )
    wanted = "a list of one-dimensional uint8 tensors with the bytes of image files"
    _expect(valid, where, f"{name!r} must be {wanted}, got {type(data).__name__}")
    return data


def load_chunk(path: UPath) -> list[Any]:
    """Load a chunk file: a list with one entry for each scene.

    A local file is memory-mapped if it has torch's zip format. Raises FileNotFoundError if the file
    does not exist, and ValueError if it is damaged, is not a list, or holds Python objects.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"chunk {path} does not exist: download it, or remove its scenes from index.json"
        )
    try:
        file = str(path) if is_local(path) else open_file(path)
        mapped = is_local(path) and zipfile.is_zipfile(file)
        # weights_only refuses Python objects, whose loading could run code
        data = torch.load(file, map_location="cpu", weights_only=True, mmap=mapped)
    except Exception as error:
        # damaged files raise anything
        reason = "it is damaged, or holds Python objects, whose loading could run code"
        # whose text advises to trust the file
        if type(error).__name__ != "UnpicklingError":
            reason = (str(error) or type(error).__name__).splitlines()[0]
        raise ValueError(
            f"{path} cannot be read as a torch file of tensors and lists ({reason}): copy or "
            "pack it again"
        ) from error
    if not isinstance(data, list):
        raise ValueError(
            f"{path} holds a value of type {type(data).__name__}, expected a list of mappings: is "
            "it a chunk of RealEstate10K's format?"
        )
    return data


class Chunk:
    """An open chunk file. entries: what the file stores of each scene, by the scene's key."""

    def __init__(self, path: UPath) -> None:
        self.path = path
        entries: dict[str, Any] = {}
        self.entries = entries
        # without `self`, so that a closed chunk leaves the memory at once
        self._parsed = cache(lambda key: parse_record(str(path), entries[key]))
        for place, entry in enumerate(load_chunk(path)):
            key = entry.get("key") if isinstance(entry, dict) else None
            if not isinstance(key, str):
                raise ValueError(
                    f"{path}: entry {place} holds a value of type {type(entry).__name__}, expected "
                    "a mapping with 'key', 'cameras' and 'images': is it a chunk of "
                    "RealEstate10K's format?"
                )
            if key in entries:
                raise ValueError(f"{path} holds the scene {key!r} twice: pack the data set again")
            entries[key] = entry

    def record(self, key: str) -> Record:
        """Return the scene `key`. Raises ValueError if it is invalid or not in this chunk."""
        if key not in self.entries:
            raise ValueError(
                f"{self.path} does not hold the scene {key!r}, although index.json says so: pack "
                "the data set again, or remove index.json to list the scenes from the chunks"
            )
        return self._parsed(key)


def has_chunks(folder: UPath) -> bool:
    """Return whether a folder holds index.json or .torch files, as folders of chunks do."""
    return any(item.name == INDEX or item.suffix == SUFFIX for item in listing(folder))


@cache
def stays_inside(name: str) -> bool:
    """Return whether a path, with / or \\, stays in the folder to which it is relative."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return bool(parts) and parts[0] != "/" and ".." not in parts and ":" not in parts[0]


def read_chunk_index(path: UPath) -> dict[str, str]:
    """Read an index.json, which maps the key of a scene to the name of its chunk.

    Raises ValueError if the file has another structure, or names a chunk outside its folder.
    """
    index = read_json(path, "copy it again, or remove it, then scenes are listed from the chunks")
    if not isinstance(index, dict) or not all(isinstance(name, str) for name in index.values()):
        raise ValueError(
            f"{path} must map each scene's key to the name of its chunk file: correct or remove it"
        )
    for key, name in index.items():
        if not stays_inside(name):
            raise ValueError(
                f"{path} names, for the scene {name_shown(key)}, the chunk {name_shown(name)!r} "
                "outside the folder of the index: correct the index, or remove it to list the "
                "scenes from the chunks"
            )
    return index


def list_scenes(folder: UPath) -> dict[str, UPath]:
    """Return the chunk file of each scene in a folder by the scene's key, in index.json's order.

    Without index.json all chunks are opened to find their scenes. Scenes whose chunk does not exist
    are left out with a warning. Raises FileNotFoundError if no scene is left, ValueError for an
    index or a chunk that cannot be read.
    """
    if not (folder / INDEX).is_file():
        return _scanned(folder)
    index = read_chunk_index(folder / INDEX)
    # one listing of the folder; asking a store for each of a thousand files takes minutes
    present = {item.name for item in listing(folder)}
    there = {n for n in set(index.values()) if n in present or ("/" in n and (folder / n).exists())}
    here = {key: folder / name for key, name in index.items() if name in there}
    missing = [f"{key} ({name})" for key, name in index.items() if name not in there]
    if not here:
        raise FileNotFoundError(
            f"{folder / INDEX} names {len(index)} scenes, but none of their chunks exists: "
            "download the chunks into this folder"
        )
    if missing:
        warn_once(
            f"{len(missing)} of {len(index)} scenes of {folder / INDEX} are left out, because "
            f"their chunks do not exist: {listed(missing)}"
        )
    return here


def _scanned(folder: UPath) -> dict[str, UPath]:
    paths = sorted((item for item in listing(folder) if item.suffix == SUFFIX), key=str)
    if not paths:
        raise FileNotFoundError(
            f"{folder} holds neither {INDEX} nor chunks ({SUFFIX} files): give the folder that "
            "holds train/ and test/"
        )
    files: dict[str, UPath] = {}
    for path in paths:
        for key in Chunk(path).entries:
            if key in files:
                raise ValueError(
                    f"the scene {key!r} is in {files[key].name} and in {path.name} of {folder}: "
                    f"remove one of the files, or write an {INDEX}"
                )
            files[key] = path
    warn_once(
        f"{folder} has no {INDEX}, so all of its {len(paths)} chunks are opened at every "
        f"start to list {len(files)} scenes: `qgs data pack` writes this file"
    )
    return files

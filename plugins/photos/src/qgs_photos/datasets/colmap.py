"""Read COLMAP's sparse models, text or binary, that lie beside a folder of photos.

Unlike pycolmap, this reader skips the points, which are most of a model, and reads from any file
system. The formats are described at colmap.github.io/format.html.
"""

import io
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import PurePosixPath
from typing import IO, Any, TypeAlias

import numpy as np
import torch
from upath import UPath

from qgs.data.photos.nerfstudio import PINHOLE
from qgs.data.photos.reader import (
    Lens,
    Listing,
    PhotoFrame,
    PhotoReader,
    image_folder,
    listed_size,
)
from qgs.geometry.transforms import quat_to_matrix
from qgs.paths import open_file
from qgs.wording import name_shown
from qgs_photos.datasets.lenses import BendingLens, Fisheye, RadialTangential, bending

_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
_MODELS: dict[str, tuple[int, str, type[BendingLens] | None]] = {
    "SIMPLE_PINHOLE": (0, "f cx cy", None),
    "PINHOLE": (1, "fx fy cx cy", None),
    "SIMPLE_RADIAL": (2, "f cx cy k1", RadialTangential),
    "RADIAL": (3, "f cx cy k1 k2", RadialTangential),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2", RadialTangential),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4", Fisheye),
    "SIMPLE_RADIAL_FISHEYE": (8, "f cx cy k1", Fisheye),
    "RADIAL_FISHEYE": (9, "f cx cy k1 k2", Fisheye),
}
"""Camera models by name: number in binary files, parameters in order, and class of the lens."""
_NAMES = {number: name for name, (number, _, _) in _MODELS.items()}
_LONGER = "a file goes on after the number of records that it announces"
_BYTES_OF_A_POINT = 24  # x, y and the point's number


class Colmap(PhotoReader):
    """Reader of the posed images of a COLMAP model, sorted by name.

    Folders are searched in the order of `_PLACES`; in each, a binary model comes before a text one.
    """

    listing = "sparse/0/{cameras,images}.{bin,txt}"

    @classmethod
    def recognises(cls, folder: UPath) -> bool:
        """See `PhotoReader`."""
        return any(_models(folder))

    @classmethod
    def lens(cls, model: str, coefficients: Mapping[str, float]) -> Lens | None:
        """See `PhotoReader`."""
        kind = Fisheye if model == "OPENCV_FISHEYE" else RadialTangential
        known = {field.name: coefficients.get(field.name, 0.0) for field in fields(kind)}
        # files with several cameras have these at the top, for all models
        others = coefficients.keys() - known.keys() - {"p1", "p2"}
        if others or not (kind is Fisheye or model in PINHOLE):
            return None
        return bending(kind(**known))

    @classmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """See `PhotoReader`."""
        model, suffix = next(_models(folder))
        read_cameras, read_images = _READ[suffix]
        try:
            listed = [*read_cameras(model)]
            cameras = {number: _camera(*camera) for number, camera in listed}
            posed = [(name, _c2w(*pose), camera) for name, pose, camera in read_images(model)]
            if len(cameras) + len({PurePosixPath(p[0]) for p in posed}) < len(listed) + len(posed):
                raise ValueError("a camera or an image is listed twice")
            if unknown := {camera for *_, camera in posed} - cameras.keys():
                raise ValueError(f"images name cameras {sorted(unknown)}, which it does not hold")
        except ValueError as error:
            raise ValueError(
                f"the COLMAP model {model} (cameras.{suffix}, images.{suffix}) cannot be read: "
                f"{name_shown(str(error))}; export it again, or copy it again"
            ) from error
        photos = image_folder(folder, images)
        frames = [
            PhotoFrame(str(PurePosixPath(photos.name, name)), photos / name, c2w, **cameras[camera])
            for name, c2w, camera in posed
        ]
        return Listing(model, sorted(frames, key=lambda frame: frame.name))


def _models(folder: UPath) -> Iterator[tuple[UPath, str]]:
    """Yield the models in `folder` and the suffix of their files, in the order of preference."""
    for place in _PLACES:
        # binary keeps all digits of a pose
        for suffix in ("bin", "txt"):
            files = (folder / place / f"{name}.{suffix}" for name in ("cameras", "images"))
            if all(file.is_file() for file in files):
                yield folder / place, suffix


Camera: TypeAlias = tuple[int, tuple[str, int, int, Sequence[float]]]
"""Number of the camera; name of its camera model, width and height in pixels, parameters."""
Image: TypeAlias = tuple[str, list[float], int]
"""Name, world-to-camera as quaternion (w, x, y, z) and translation (x, y, z), camera's number."""


def _text_cameras(model: UPath) -> Iterator[Camera]:
    for line in _lines(model / "cameras.txt"):
        number, name, width, height, *parameters = line.split()
        if "_" in "".join([number, width, height, *parameters]):  # Python reads 1_000 as a number
            raise ValueError(f"cameras.txt has a number with an underscore in {line[:60]!r}")
        yield int(number), (name, int(width), int(height), [*map(float, parameters)])


def _text_images(model: UPath) -> Iterator[Image]:
    for line in _lines(model / "images.txt", points=True):
        number, *fields = line.split(maxsplit=9)
        if len(fields) != 9 or not number.isdecimal() or "_" in "".join(fields[:8]):
            raise ValueError(f"images.txt has {line[:60]!r}, expected 9 numbers and a name")
        yield fields[8], [*map(float, fields[:7])], int(fields[7])


def _lines(file: UPath, points: bool = False) -> Iterator[str]:
    """Yield the lines of a file without comments.

    points: skip the line after each, which lists points. Raises ValueError if it is missing.
    """
    with io.TextIOWrapper(open_file(file), encoding="utf-8") as lines:
        for line in lines:
            if (line := line.strip()) and not line.startswith("#"):
                yield line
                if points and len(next(lines, "").split()) % 3:  # x, y, number of each point
                    raise ValueError(f"{file.name} has no line of points after {line[:60]!r}")


def _binary_cameras(model: UPath) -> Iterator[Camera]:
    with open_file(model / "cameras.bin") as file:
        for _ in range(_unpacked("<Q", file)[0]):
            number, kind, width, height = _unpacked("<IiQQ", file)
            name = _NAMES.get(kind, f"number {kind}")
            parameters = _unpacked(f"<{len(_parameters(name))}d", file)
            yield number, (name, width, height, parameters)
        if file.read(1):
            raise ValueError(_LONGER)


def _binary_images(model: UPath) -> Iterator[Image]:
    with open_file(model / "images.bin") as file:
        for _ in range(_unpacked("<Q", file)[0]):
            _, *pose, camera = _unpacked("<I7dI", file)
            name = b"".join(iter(lambda: _unpacked("<c", file)[0], b"\0")).decode("utf-8")
            if points := _unpacked("<Q", file)[0]:  # skipped unread: they are most of the file
                file.seek(_BYTES_OF_A_POINT * min(points, 2**50) - 1, 1)
                _unpacked("<c", file)
            yield name, pose, camera
        if file.read(1):
            raise ValueError(_LONGER)


_READ = {"txt": (_text_cameras, _text_images), "bin": (_binary_cameras, _binary_images)}


def _unpacked(format: str, file: IO[bytes]) -> tuple[Any, ...]:
    content = file.read(struct.calcsize(format))
    if len(content) < struct.calcsize(format):
        raise ValueError("a file is cut off")
    return struct.unpack(format, content)


def _parameters(model: str) -> list[str]:
    """Return the names of a camera model's parameters. Raises ValueError for an unknown model."""
    if model not in _MODELS:
        known = ", ".join(_MODELS)
        fix = f"undistort the photos with `colmap image_undistorter`, or use one of {known}"
        raise ValueError(f"the camera model {model} is not known: {fix}")
    return _MODELS[model][1].split()


def _camera(model: str, width: int, height: int, parameters: Sequence[float]) -> dict[str, Any]:
    """Return the fields of a `PhotoFrame` that follow from its camera, by name."""
    values = dict(zip(_parameters(model), parameters, strict=True))
    size, problems = listed_size(height, width)
    focal = values.pop("f", math.nan)  # simple models have one for both axes
    fx = values.pop("fx", focal)
    fy = values.pop("fy", focal)
    intrinsics = fx, fy, values.pop("cx"), values.pop("cy")
    kind = _MODELS[model][2]
    lens = bending(kind(**values)) if kind else None
    return {"size": size, "problems": problems, "intrinsics": intrinsics, "lens": lens}


def _c2w(*cam_from_world: float) -> np.ndarray:
    """Return OpenCV camera-to-world (4, 4) from COLMAP's quaternion and translation.

    COLMAP's pose maps the world to the camera. Raises ValueError unless the quaternion has length 1
    within 0.1.
    """
    quaternion, translation = torch.tensor(cam_from_world, dtype=torch.float64).split([4, 3])
    if abs(float(quaternion.norm()) - 1) > 0.1:
        raise ValueError(f"the quaternion {[*cam_from_world[:4]]} of an image must have length 1")
    rotation = quat_to_matrix(quaternion / quaternion.norm()).T
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[:3, :3] = rotation
    c2w[:3, 3] = -rotation @ translation
    return c2w.numpy()

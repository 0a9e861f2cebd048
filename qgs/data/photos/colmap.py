"""COLMAP: a sparse model, text or binary, beside a folder of photos.

Points, which are most of a model, are not read, and models may lie on any file system, which
pycolmap's own readers do not offer; pycolmap says what the parameters of a camera model mean.
"""

import io
import math
import struct
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import PurePosixPath
from typing import IO, Any, TypeAlias

import numpy as np
from upath import UPath

from qgs.contracts import MissingExtraError
from qgs.data.lenses import Fisheye, Lens, RadialTangential, bending
from qgs.data.paths import open_file
from qgs.data.photos.checks import FrameProblem, listed_size
from qgs.data.photos.reader import Listing, PhotoFrame, PhotoReader, image_folder
from qgs.wording import name_shown

_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
_LENSES: dict[str, type[Lens] | None] = {
    "SIMPLE_PINHOLE": None,
    "PINHOLE": None,
    "SIMPLE_RADIAL": RadialTangential,
    "RADIAL": RadialTangential,
    "OPENCV": RadialTangential,
    "OPENCV_FISHEYE": Fisheye,
    "SIMPLE_RADIAL_FISHEYE": Fisheye,
    "RADIAL_FISHEYE": Fisheye,
}
_BYTES_OF_A_POINT = 24  # x, y and the point's number


class Colmap(PhotoReader):
    """The posed images by name, of a binary model before a text one, as `_PLACES` are ordered."""

    name = "colmap"
    listing = "sparse/0/{cameras,images}.{bin,txt}"
    poses = "opencv"

    @classmethod
    def recognises(cls, folder: UPath) -> bool:
        """See `PhotoReader`."""
        return any(_models(folder))

    @classmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """See `PhotoReader`. Raises MissingExtraError without pycolmap."""
        model, suffix = next(_models(folder))
        if find_spec("pycolmap") is None:
            raise MissingExtraError(
                f"reading the COLMAP model {model} needs pycolmap, which is not installed: run "
                '`pip install "query-gaussians[colmap]"`'
            )
        read_cameras, read_images = _READ[suffix]
        try:
            cameras = {number: _camera(*camera) for number, camera in read_cameras(model)}
            posed = list(read_images(model))
            unknown = {camera for *_, camera in posed} - cameras.keys()
            if unknown:
                raise ValueError(f"images are of cameras {sorted(unknown)}, which are not in it")
        except ValueError as error:
            raise ValueError(
                f"the COLMAP model {model} (cameras.{suffix}, images.{suffix}) cannot be read: "
                f"{name_shown(str(error))}; export it again, or copy it again"
            ) from error
        photos = image_folder(folder, images)
        frames = [
            PhotoFrame(
                str(PurePosixPath(photos.name, name)), photos / name, _c2w(*pose), **cameras[camera]
            )
            for name, pose, camera in posed
        ]
        return Listing(model, sorted(frames, key=lambda frame: frame.name))


def _models(folder: UPath) -> Iterator[tuple[UPath, str]]:
    """The models in `folder` and the suffix of their files, in the order of preference."""
    for place in _PLACES:
        for suffix in ("bin", "txt"):
            files = (folder / place / f"{name}.{suffix}" for name in ("cameras", "images"))
            if all(file.is_file() for file in files):
                yield folder / place, suffix


Camera: TypeAlias = tuple[int, tuple[str, int, int, Sequence[float]]]
"""Number, and the name of the model, width, height and parameters."""
Image: TypeAlias = tuple[str, list[float], int]
"""Name, quaternion (w, x, y, z) with translation (x, y, z), number of the camera."""


def _text_cameras(model: UPath) -> Iterator[Camera]:
    for line in _lines(model / "cameras.txt"):
        number, name, width, height, *parameters = line.split()
        yield int(number), (name, int(width), int(height), [*map(float, parameters)])


def _text_images(model: UPath) -> Iterator[Image]:
    for line in _lines(model / "images.txt", after=1):  # a line of points follows each image
        number, *fields = line.split(maxsplit=9)
        if len(fields) != 9 or not number.isdecimal():
            raise ValueError(
                f"images.txt has the line {line[:60]!r} where an image was expected: 9 numbers "
                "and a name, then a line of points, which may be empty"
            )
        yield fields[8], [*map(float, fields[:7])], int(fields[7])


def _lines(file: UPath, after: int = 0) -> Iterator[str]:
    """Content lines of a file without comments; skips `after` lines following each."""
    with io.TextIOWrapper(open_file(file), encoding="utf-8") as lines:
        for line in lines:
            if (line := line.strip()) and not line.startswith("#"):
                yield line
                for _ in range(after):
                    next(lines, None)


def _binary_cameras(model: UPath) -> Iterator[Camera]:
    import pycolmap

    with open_file(model / "cameras.bin") as file:
        for _ in range(_unpacked("<Q", file)[0]):
            number, kind, width, height = _unpacked("<IiQQ", file)
            name = pycolmap.CameraModelId(kind).name
            parameters = _unpacked(f"<{len(_parameters(name))}d", file)
            yield number, (name, width, height, parameters)


def _binary_images(model: UPath) -> Iterator[Image]:
    with open_file(model / "images.bin") as file:
        for _ in range(_unpacked("<Q", file)[0]):
            _, *pose, camera = _unpacked("<I7dI", file)
            name = b"".join(iter(lambda: _unpacked("<c", file)[0], b"\0")).decode("utf-8")
            # skipped unread: points are most of the file
            file.seek(_BYTES_OF_A_POINT * _unpacked("<Q", file)[0], 1)
            yield name, pose, camera


_READ = {"txt": (_text_cameras, _text_images), "bin": (_binary_cameras, _binary_images)}


def _unpacked(format: str, file: IO[bytes]) -> tuple[Any, ...]:
    content = file.read(struct.calcsize(format))
    if len(content) < struct.calcsize(format):
        raise ValueError("a file is cut off")
    return struct.unpack(format, content)


def _parameters(model: str) -> list[str]:
    """Names of the parameters of a camera model. Raises ValueError for one unknown to pycolmap."""
    import pycolmap

    kind = pycolmap.CameraModelId.__members__.get(model)
    if kind is None:
        raise ValueError(f"there is no camera model {model}")
    return pycolmap.Camera.create_from_model_id(1, kind, 1.0, 1, 1).params_info.split(", ")


def _camera(model: str, width: int, height: int, parameters: Sequence[float]) -> dict[str, Any]:
    """Fields of a `PhotoFrame` that the camera took."""
    values = dict(zip(_parameters(model), parameters, strict=True))
    size, problems = listed_size(height, width)
    fields: dict[str, Any] = {"size": size, "problems": problems}
    if model not in _LENSES:
        fix = f"undistort with `colmap image_undistorter`, or use one of {', '.join(_LENSES)}"
        problem = FrameProblem("lens", f"the camera model {model} is not known", fix)
        return {**fields, "intrinsics": (math.nan,) * 4, "problems": (problem,)}
    focal = values.pop("f", math.nan)
    fx, fy = values.pop("fx", focal), values.pop("fy", focal)
    fields["intrinsics"] = (fx, fy, values.pop("cx"), values.pop("cy"))
    lens = _LENSES[model]
    if lens is not None:
        fields["lens"] = bending(lens(**{"k1" if k == "k" else k: v for k, v in values.items()}))
    return fields


def _c2w(*cam_from_world: float) -> np.ndarray:
    """OpenCV camera-to-world; COLMAP gives world-to-camera, with a quaternion of any length."""
    import pycolmap

    w, x, y, z, *translation = cam_from_world
    quaternion = np.array([x, y, z, w])
    length = np.linalg.norm(quaternion)
    if not 0 < length < math.inf:
        return np.full((4, 4), np.nan)
    c2w = np.eye(4)
    rotation = pycolmap.Rotation3d(quaternion / length).matrix().T
    c2w[:3, :3], c2w[:3, 3] = rotation, -rotation @ translation
    return c2w

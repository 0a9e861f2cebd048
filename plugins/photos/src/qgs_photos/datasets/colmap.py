"""Read COLMAP's sparse models, text or binary, that lie beside a folder of photos.

Unlike pycolmap, this reader skips the points, which make up most of a model, and it reads from
any file system. The formats are described at colmap.github.io/format.html.
"""

import io
import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from fnmatch import fnmatch
from functools import cache
from itertools import chain
from pathlib import PurePosixPath
from typing import IO, Any

import numpy as np
import torch
from upath import UPath

from qgs.data.photos.finding import is_inside
from qgs.data.photos.nerfstudio import PINHOLE
from qgs.data.photos.reader import (
    FrameProblem,
    Lens,
    Listing,
    PhotoFrame,
    PhotoReader,
    image_folder,
    listed_size,
)
from qgs.geometry.transforms import quat_to_matrix
from qgs.paths import listing, open_file
from qgs.wording import listed, name_shown, warn_once
from qgs_photos.datasets.lenses import FOCAL, bending, model_name, parameters
from qgs_photos.image_files import image_files

_PLACES = (
    "sparse/*",
    "sparse",
    "colmap/sparse/*",
    "colmap/sparse",
    ".",
    "dense/sparse",
    "dense/*/sparse",
)
_LONGER = "a file has more data than the number of records at its start says"
_BYTES_OF_A_POINT = 24  # x, y and the point's number


class Colmap(PhotoReader):
    """Reader of the posed images of a COLMAP model, sorted by name.

    Models are searched in the folders of `_PLACES`, in this order, in upper or lower case. In a
    folder with a binary and a text model, the binary one is read.
    """

    listing = "sparse/0/{cameras,images}.{bin,txt}"

    @classmethod
    def recognises(cls, folder: UPath) -> bool:
        """Return whether `folder` has a COLMAP model, itself or in a folder such as sparse/0."""
        return any(not missing for *_, missing in models(folder))

    @classmethod
    def lens(cls, model: str, coefficients: Mapping[str, float]) -> Lens | None:
        """Return the lens of a camera model; None if the model or a coefficient is unknown.

        model: name of the model in nerfstudio or COLMAP. coefficients: nonzero distortion
        coefficients by name, such as k1.
        """
        # nerfstudio has a k3 in models where COLMAP has none
        kind = "FULL_OPENCV" if model in PINHOLE else model
        with suppress(ValueError):
            # files with several cameras have p1 and p2 at the top, for all models
            known = {"p1", "p2", *parameters(kind)}
            known -= {"k4", "k5", "k6"} if kind != model else set()
            return None if coefficients.keys() - known else bending(kind, coefficients)
        return None

    @classmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """Read the posed photos of a COLMAP model that `folder` has.

        Of several models, the one with most photos is read; models whose folder of photos exists
        come before others. A warning names the models that are not read. Raises ValueError for an
        unreadable model.
        """
        found = [_read(place, end) for place, end, missing in models(folder) if not missing]
        # beside its own photos first: those of dense/0 are undistorted; then the largest
        best = max(found, key=lambda one: (_has_photos(one.folder or folder), len(one.frames)))
        if others := [f"{one.file} ({len(one.frames)})" for one in found if one is not best]:
            warn_once(
                f"{len(found)} COLMAP models exist: {best.file} with {len(best.frames)} photos is "
                f"read, and not {listed(others)}"
            )
        if best.folder and not is_inside(folder, best.folder):
            warn_once(f"{folder} holds a COLMAP model: its photos are read from {best.folder}")
        return best


def _read(model: UPath, suffix: str) -> Listing:
    """Read the posed photos of a model, sorted by name.

    model: folder of the model. suffix: bin or txt. Raises ValueError for unreadable files.
    """
    read_cameras, read_images = _READ[suffix]
    try:
        listed = [*read_cameras(model)]
        cameras = {number: _camera(*camera) for number, camera in listed}
        posed = [*read_images(model)]
        if len(cameras) + len({PurePosixPath(p[0]) for p in posed}) < len(listed) + len(posed):
            raise ValueError("a camera or an image is listed twice")
    except ValueError as error:
        raise ValueError(
            f"the COLMAP model {model} (cameras.{suffix}, images.{suffix}) cannot be read: "
            f"{name_shown(str(error))}; export it again, or copy it again"
        ) from error
    folder = _project(model)
    photos = image_folder(folder, None)
    frames = list[PhotoFrame]()
    for name, pose, number in posed:
        inside = name if photos == folder else f"{photos.name}/{name}"
        camera = cameras.get(number) or _faulty(f"there is no camera {number}")
        frames.append(PhotoFrame(inside, folder / inside, _c2w(*pose), **camera))
    return Listing(model, sorted(frames, key=lambda frame: frame.name), folder)


def _project(model: UPath) -> UPath:
    """Return the folder of the scene to which a COLMAP model belongs; it holds the photos.

    For a model in sparse/ or colmap/sparse/, this is the folder that contains sparse/ or colmap/.
    For a model elsewhere, or with photos beside its files, it is the model's folder.
    """
    places = (model, model.parent)
    sparse = next((place for place in places if place.absolute().name.lower() == "sparse"), None)
    if sparse is None or image_files(model):
        return model
    return sparse.parent.parent if sparse.parent.name.lower() == "colmap" else sparse.parent


def _has_photos(folder: UPath) -> bool:
    return image_folder(folder, None) != folder or bool(image_files(folder))


def models(folder: UPath) -> Iterator[tuple[UPath, str, set[str]]]:
    """Yield each COLMAP model in `folder`: its folder, the suffix of its files, and missing files.

    A folder with one of a model's two files counts as a model, too.
    """
    inside = cache(listing)
    for pattern in (*_PLACES, "*") if folder.name.lower() == "sparse" else _PLACES:
        places = [folder]
        for part in PurePosixPath(pattern).parts:
            items = sorted(chain.from_iterable(map(inside, places)), key=str)
            places = [item for item in items if fnmatch(item.name.lower(), part)]
        for place in places:
            held = {item.name for item in inside(place)}
            # binary keeps all digits of a pose
            for suffix in ("bin", "txt"):
                needed = {f"cameras.{suffix}", f"images.{suffix}"}
                if needed & held:
                    yield place, suffix, needed - held
                if needed <= held:
                    break


Camera = tuple[int, tuple[str, float, float, Sequence[float]]]
"""Number of the camera; name of its camera model, width and height in pixels, parameters."""
Image = tuple[str, list[float], int]
"""Name, world-to-camera as quaternion (w, x, y, z) and translation (x, y, z), camera's number."""


def _text_cameras(model: UPath) -> Iterator[Camera]:
    for line in read_lines(model / "cameras.txt"):
        number, name, width, height, *parameters = line.split()
        yield int(number), (name, _number(width), _number(height), [*map(_number, parameters)])


def _text_images(model: UPath) -> Iterator[Image]:
    file = model / "images.txt"
    with open_file(file) as opened:
        # within the first lines; other programs leave it out
        told = re.search(rb"# Number of images: (\d+)", opened.read(1000))
    lines = [*read_lines(file)]
    posed = [line for line in lines if not _is_points(line)]
    # a pose that is cut off may pass for points
    expected = max(int(told[1]) if told else 0, len(lines) - len(posed))
    if len(posed) < expected:
        raise ValueError(
            f"images.txt has {len(posed)} poses, not {expected}: it is cut off, or its header wrong"
        )
    if 1 < len(posed) == len(lines):
        warn_once(f"{file} lists no 2D points: all {len(posed)} lines are poses")
    for line in posed:
        number, *fields = line.split(maxsplit=9)
        if len(fields) != 9 or not number.isdecimal() or not fields[7].isdecimal():
            raise ValueError(
                f"images.txt has the line {line[:60]!r}, expected 9 numbers and a file name: it is "
                "cut off or damaged"
            )
        yield fields[8], [*map(_number, fields[:7])], int(fields[7])


def _is_points(line: str) -> bool:
    """Return whether a line of images.txt lists points (x, y, number) and is not a pose.

    The number of a point is an integer, unlike what the start of a pose has in its place.
    """
    words = line.split()
    # the first points and the last: there are thousands
    values = [*map(_number, words[:12] + words[-1:])]
    are_integers = all(map(float.is_integer, values[2::3]))
    return len(words) % 3 == 0 and are_integers and not np.isnan(values).any()


def _number(word: str) -> float:
    """Return the number that `word` spells; NaN for other words, such as -nan(ind)."""
    # Python reads 1_000
    with suppress(ValueError):
        return float(word.replace("_", "?"))
    return math.nan


def read_lines(file: UPath) -> Iterator[str]:
    """Yield the lines of a file that are neither blank nor a comment, stripped of spaces."""
    with io.TextIOWrapper(open_file(file), encoding="utf-8-sig") as lines:
        for line in lines:
            if (line := line.strip()) and not line.startswith("#"):
                yield line


def _binary_cameras(model: UPath) -> Iterator[Camera]:
    with open_file(model / "cameras.bin") as file:
        for _ in range(_unpacked("<Q", file)[0]):
            number, kind, width, height = _unpacked("<IiQQ", file)
            name = model_name(kind)
            yield number, (name, width, height, _unpacked(f"<{len(parameters(name))}d", file))
        if file.read(1):
            raise ValueError(_LONGER)


def _binary_images(model: UPath) -> Iterator[Image]:
    with open_file(model / "images.bin") as file:
        for _ in range(_unpacked("<Q", file)[0]):
            _, *pose, camera = _unpacked("<I7dI", file)
            name = b"".join(iter(lambda: _unpacked("<c", file)[0], b"\0")).decode()
            if points := _unpacked("<Q", file)[0]:  # skipped unread: they are most of the file
                file.seek(_BYTES_OF_A_POINT * min(points, 2**32) - 1, 1)
                _unpacked("<c", file)
            yield name, pose, camera
        if file.read(1):
            raise ValueError(_LONGER)


_READ = {"txt": (_text_cameras, _text_images), "bin": (_binary_cameras, _binary_images)}


def _unpacked(format: str, file: IO[bytes]) -> tuple[Any, ...]:
    content = file.read(struct.calcsize(format))
    if len(content) < struct.calcsize(format):
        raise ValueError("a file ends inside a record: it is cut off")
    return struct.unpack(format, content)


def _camera(model: str, width: float, height: float, values: Sequence[float]) -> dict[str, Any]:
    """Return the size, intrinsics, lens and problems of a camera, as fields of `PhotoFrame`.

    model: COLMAP's name of the camera model. width, height: in pixels. values: the model's
    parameters.
    """
    size, problems = listed_size(height, width)
    try:
        if not np.isfinite(values).all():
            raise ValueError("a parameter of the camera is not a finite number")
        named = dict(zip(parameters(model), values, strict=True))
        # simple models have one focal length for both axes
        focal = [named.pop(key) for key in FOCAL if key in named]
        intrinsics = (*(focal[:1] + focal[-1:]), named.pop("cx"), named.pop("cy"))
        lens = bending(model, named)
    except (ValueError, KeyError):
        numbers = f"{len(values)} numbers: {' '.join(map(str, values))[:80]}"
        return _faulty(f"the camera is not one that COLMAP knows, {model} of {numbers}")
    return {"size": size, "problems": problems, "intrinsics": intrinsics, "lens": lens}


def _faulty(reason: str) -> dict[str, Any]:
    """Return fields of `PhotoFrame` for a photo without a valid camera; `reason` says why."""
    fix = "export the model again, or undistort the photos with `colmap image_undistorter`"
    return {"intrinsics": (math.nan,) * 4, "problems": (FrameProblem(reason, fix),)}


def _c2w(*cam_from_world: float) -> np.ndarray:
    """Return OpenCV camera-to-world (4, 4) from COLMAP's quaternion and translation.

    COLMAP's pose maps the world to the camera. NaN if the quaternion's length is 0.
    """
    quaternion, translation = torch.tensor(cam_from_world, dtype=torch.float64).split([4, 3])
    rotation = quat_to_matrix(quaternion / quaternion.norm()).T
    rows = torch.column_stack([rotation, -rotation @ translation])
    return np.vstack([rows, [0, 0, 0, 1]])

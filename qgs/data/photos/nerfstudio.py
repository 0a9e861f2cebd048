"""Reader of `transforms.json` from nerfstudio, and from Blender and DL3DV in the same schema."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from PIL import Image
from upath import UPath

from qgs.data.images import image_size, read_image
from qgs.data.photos.finding import found_files
from qgs.data.photos.reader import (
    FrameProblem,
    Intrinsics,
    Lens,
    Listing,
    PhotoFrame,
    PhotoReader,
    Size,
    installed_readers,
    listed_size,
    numbers,
)
from qgs.paths import read_json

PINHOLE = (
    "PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE", "FULL_OPENCV",
)  # fmt: skip
"""Camera models that are a pinhole if all distortion coefficients are 0."""
_COEFFICIENTS = (
    "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4", "tau_x", "tau_y",
    "sx1", "sy1", "b1", "b2",
)  # fmt: skip
_MATRICES = ("K", "intrinsic_matrix", "intrinsics", "camera_matrix")
_NO_POSE = np.full((4, 4), np.nan)
_NO_INTRINSICS: Intrinsics = (math.nan, math.nan, math.nan, math.nan)
# Of a pose's columns: the camera's y and z axes change sign.
_OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0, 1.0])


class Nerfstudio(PhotoReader):
    """Photo reader for `transforms.json`, with masks, depth maps and splits.

    If the folder `images` of a listing is missing, scaled copies such as images_4 are read.
    """

    listing = "transforms.json"

    @classmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """Read the frames in the order of the file; raise the errors of `PhotoReader.read`."""
        file = folder / cls.listing
        return Listing(file, read_transforms(file))


def read_transforms(file: UPath) -> list[PhotoFrame]:
    """Read the frames of a transforms.json, in its order; bad values become problems of a frame.

    Raises ValueError for a file without frames or with wrong splits.
    """
    data = read_json(file, "export the file again")
    entries = data.get("frames") if isinstance(data, Mapping) else None
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{file} lists no frames: expected a non-empty list under 'frames'")
    folder = file.parent
    frames = [_frame(folder, data, entry, None) for entry in entries]
    try:
        # An angle of view needs the image's size; a header is read only where nothing lists one.
        if any(frame.problems and not frame.size for frame in frames):
            present = found_files(folder, [frame.path for frame in frames if frame.name])
            first = next(iter(present.values()), None)
            size = read_image(first, image_size) if first else None
            frames = [_frame(folder, data, entry, size) for entry in entries]
        return _with_splits(frames, data)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _frame(folder: UPath, data: Mapping[str, Any], entry: Any, size: Size | None) -> PhotoFrame:
    """Read an entry of 'frames'; values that cannot be read become problems of the frame.

    data: the whole file; its values apply to entries that lack them. size: (H, W) of the image if
        neither the entry nor `data` has 'h' and 'w'.
    """
    path = entry.get("file_path") if isinstance(entry, Mapping) else None
    if not isinstance(path, str) or not PurePosixPath(path).name or "://" in path:
        problem = FrameProblem("its 'file_path' names no file", "correct or remove the frame")
        return PhotoFrame("", folder, _NO_POSE, _NO_INTRINSICS, problems=(problem,))
    values = _Values({**_flat(data), **_flat(entry)})
    height = values.number("h")
    width = values.number("w")
    if height is not None and width is not None:
        listed, problems = listed_size(height, width)
        size = listed or size
        values.problems += problems
    name = image_name(path)
    mask = entry.get("mask_path")
    depth = entry.get("depth_file_path")
    return PhotoFrame(
        name=name,
        path=folder / name,
        c2w=_pose(entry.get("transform_matrix"), values),
        intrinsics=_intrinsics(values, size),
        size=size,
        lens=_lens(values),
        mask=folder / mask if isinstance(mask, str) and mask else None,
        depth=folder / depth if isinstance(depth, str) and depth else None,
        # A time at the top of the file would be that of no photo.
        time=values.number("time") if "time" in entry else None,
        problems=tuple(values.problems),
    )


def _flat(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return `values` with fl_x, fl_y, cx, cy from a matrix of intrinsics in `values`, if any."""
    matrix = numbers(next((values[key] for key in _MATRICES if key in values), None))
    if matrix.shape != (3, 3):
        return values
    names = ("fl_x", "fl_y", "cx", "cy")
    return {**dict(zip(names, matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True)), **values}


class _Values(dict[str, Any]):
    """Values of a frame in the file, and the problems found while reading them."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.problems: list[FrameProblem] = []

    def problem(self, reason: str, fix: str) -> None:
        self.problems.append(FrameProblem(reason, fix))

    def number(self, key: str) -> float | None:
        """Return the finite number under `key`, or None if it is absent, null or invalid.

        An invalid value is added to `problems`.
        """
        value = self.get(key)
        # Some programs write numbers as text.
        read = numbers([value])
        if read.shape == (1,) and not isinstance(value, bool) and math.isfinite(read[0]):
            return float(read[0])
        if value is not None:
            shown = str(value)[:99]
            self.problem(f"{key!r} must be a finite number, got {shown!r}", "correct the value")
        return None


def image_name(file_path: str) -> str:
    """Return `file_path` with `/` as separator; append .png if it has no suffix, as in Blender."""
    name = PurePosixPath(file_path.replace("\\", "/"))
    suffix = name.suffix.lower()
    known = suffix[1:].isalpha() or suffix in Image.registered_extensions()
    return str(name if known else name.with_name(f"{name.name}.png"))


def _pose(matrix: object, values: _Values) -> np.ndarray:
    c2w = numbers(matrix)
    if c2w.shape == (3, 4):
        c2w = np.vstack([c2w, [0, 0, 0, 1]])
    if c2w.shape != (4, 4):
        values.problem("'transform_matrix' must be 4 x 4 numbers", "export the pose again")
        return _NO_POSE
    return c2w * _OPENGL_TO_OPENCV


def _intrinsics(values: _Values, size: Size | None) -> Intrinsics:
    fx = _focal(values, "x", size and size[1])
    # Pixels are square unless listed.
    fy = _focal(values, "y", size and size[0]) or fx
    if fx is None or fy is None:
        values.problem(
            "the focal length is missing",
            "add 'fl_x' (pixels), or 'camera_angle_x' (radians) with 'w' and 'h', to the frame "
            "or to the top of the file",
        )
        return _NO_INTRINSICS
    cx = values.number("cx")
    cy = values.number("cy")
    if size is None and (cx is None or cy is None):
        reason = "neither 'cx' and 'cy' nor 'w' and 'h' are given"
        values.problem(reason, "add one of the two pairs")
        return _NO_INTRINSICS
    height, width = size or (0, 0)
    return fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy


def _focal(values: _Values, axis: str, side: int | None) -> float | None:
    """Return the focal length in pixels along an axis; None without a valid value.

    The value is the listed focal length, or else comes from the listed angle of view. axis: "x" or
    "y". side: width or height of the image in pixels.
    """
    angle = values.number(f"camera_angle_{axis}")
    given = values.number(f"fl_{axis}")
    if given or angle is None or side is None or not 0 < angle < math.pi:
        return given or None
    return side / 2 / math.tan(angle / 2)


def _lens(values: _Values) -> Lens | None:
    fisheye = values.get("is_fisheye")
    # No name is longer.
    given = str(values.get("camera_model") or "PINHOLE")[:99]
    model = "OPENCV_FISHEYE" if fisheye else given
    # An ignored coefficient would shift pixels against the poses without an error.
    found = {key: number for key in _COEFFICIENTS if (number := values.number(key))}
    if model in PINHOLE and not found:
        return None
    lenses = (reader.lens(model, found) for reader in installed_readers().values())
    if (lens := next(filter(None, lenses), None)) is None:
        values.problem(
            f"no installed format knows the lens of camera model {model!r} with {found}",
            "install query-gaussians-photos, which knows OPENCV (k1 to k3, p1, p2) and "
            "OPENCV_FISHEYE (k1 to k4), or undistort the photos first",
        )
    return lens


def _is_end(first: str, second: str) -> bool:
    """Return whether one path is the other without its first folders."""
    return f"/{first}".endswith(f"/{second}") or f"/{second}".endswith(f"/{first}")


def _with_splits(frames: Sequence[PhotoFrame], data: Mapping[str, Any]) -> list[PhotoFrame]:
    """Return `frames` with the splits that nerfstudio's lists of file names give.

    Frames in no list belong to the split that has no list; if both splits have lists, these frames
    are unused. A frame in both lists is a test frame. If no frame has a listed name, the list and
    the frames may differ in leading folders: the end of one name may be the other name.
    """
    known = {frame.name for frame in frames}

    def named(part: str) -> set[str]:
        key = f"{part}_filenames"
        given = data.get(key) or []
        if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
            raise ValueError(f"{key!r} must be a list of file names, got {given!r}")
        names = set[str]()
        for wanted in map(image_name, given):
            fitting = {wanted} & known or {name for name in known if _is_end(name, wanted)}
            if len(fitting) != 1:
                raise ValueError(
                    f"{key!r} names {wanted}, but {len(fitting)} frames are called so: correct it"
                )
            names |= fitting
        return names

    train = named("train")
    test = named("test") | named("val")
    splits = dict.fromkeys(train, "train") | dict.fromkeys(test, "test")
    rest = "train" if test else None
    if train:
        rest = "unused" if test else "test"
    return [replace(frame, split=splits.get(frame.name, rest)) for frame in frames]

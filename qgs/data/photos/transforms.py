"""`transforms.json` of nerfstudio, and Blender's of the same schema."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from PIL import Image
from upath import UPath

from qgs.data.lenses import Fisheye, Lens, RadialTangential, bending
from qgs.data.photos.frames import Fault, Intrinsics, PhotoFrame, Size

_PINHOLE = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = ("OPENCV_FISHEYE",)
_RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3")
_OTHER = ("k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y", "sx1", "sy1", "b1", "b2")
_NO_INTRINSICS: Intrinsics = (math.nan, math.nan, math.nan, math.nan)
_UNDISTORT = "undistort the photos first"
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


class _UnreadableError(Exception):
    """A value of a frame that cannot be read; carries the fault."""

    def __init__(self, reason: str, fix: str) -> None:
        super().__init__(reason)
        self.fault = Fault(reason, fix)


def load_transforms(file: UPath) -> Mapping[str, Any]:
    """The content of a transforms file. Raises ValueError when it is no JSON that lists frames."""
    try:
        data = json.loads(file.read_text(encoding="utf-8-sig"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} is not valid JSON: {error}; export it again") from error
    frames = data.get("frames") if isinstance(data, Mapping) else None
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{file} lists no frames: expected a non-empty list under 'frames'")
    return data


def parse_transforms(
    data: Mapping[str, Any], folder: UPath, size: Size | None = None
) -> list[PhotoFrame]:
    """The frames that `data` lists, in its order; file names are relative to `folder`.

    size: (H, W) of the images where neither a frame nor the top of `data` gives 'h' and 'w'.
    Raises ValueError for a split that names a file that no frame has.
    """
    frames = [_frame(folder, data, entry, size) for entry in data["frames"]]
    return _with_splits(frames, data)


def _frame(folder: UPath, data: Mapping[str, Any], entry: Any, size: Size | None) -> PhotoFrame:
    path = entry.get("file_path") if isinstance(entry, Mapping) else None
    if not isinstance(path, str) or not PurePosixPath(path).name:
        fault = Fault("it has no 'file_path'", "add the image's name, or remove the frame")
        return PhotoFrame("", folder, _no_pose(), _NO_INTRINSICS, faults=(fault,))
    values = {**data, **entry}
    size = _size(values) or size
    name = image_name(path)
    faults: list[Fault] = []
    c2w, intrinsics, lens = _no_pose(), _NO_INTRINSICS, None
    try:
        c2w = _pose(entry)
    except _UnreadableError as error:
        faults.append(error.fault)
    try:
        intrinsics = _intrinsics(values, size)
    except _UnreadableError as error:
        faults.append(error.fault)
    try:
        lens = _lens(values)
    except _UnreadableError as error:
        faults.append(error.fault)
    return PhotoFrame(
        name, folder / name, c2w, intrinsics, size, lens,
        _beside(folder, entry, "mask_path"), _beside(folder, entry, "depth_file_path"),
        faults=tuple(faults),
    )  # fmt: skip


def image_name(file_path: str) -> str:
    """`file_path` in one spelling; one without an image's suffix, as in Blender's sets, is PNG."""
    name = PurePosixPath(file_path.replace("\\", "/"))
    suffix = name.suffix.lower()
    known = suffix[1:].isalpha() or suffix in Image.registered_extensions()
    return str(name if known else name.with_name(f"{name.name}.png"))


def _no_pose() -> np.ndarray:
    return np.full((4, 4), np.nan)


def _beside(folder: UPath, entry: Mapping[str, Any], key: str) -> UPath | None:
    name = entry.get(key)
    return folder / name if isinstance(name, str) and name else None


def _pose(entry: Mapping[str, Any]) -> np.ndarray:
    """OpenGL to OpenCV: the camera's y and z axes change sign."""
    try:
        c2w = np.array(entry.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        c2w = np.zeros(0)
    if c2w.shape == (3, 4):
        c2w = np.vstack([c2w, [0, 0, 0, 1]])
    if c2w.shape != (4, 4):
        raise _UnreadableError("'transform_matrix' must be 4 x 4 numbers", "export the pose again")
    return c2w @ _OPENGL_TO_OPENCV


def _number(values: Mapping[str, Any], key: str) -> float | None:
    """A number, NaN included; None where it is absent, null or something else."""
    value = values.get(key)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _size(values: Mapping[str, Any]) -> Size | None:
    sides = [_number(values, key) for key in ("h", "w")]
    height, width = (side if side and math.isfinite(side) else 0 for side in sides)
    return (round(height), round(width)) if height >= 1 and width >= 1 else None


def _intrinsics(values: Mapping[str, Any], size: Size | None) -> Intrinsics:
    fx = _number(values, "fl_x") or _from_angle(_number(values, "camera_angle_x"), size, 1)
    fy = _number(values, "fl_y") or _from_angle(_number(values, "camera_angle_y"), size, 0) or fx
    if fx is None or fy is None:
        raise _UnreadableError(
            "there is no focal length",
            "expected 'fl_x' (pixels), or 'camera_angle_x' (radians) with 'w' and 'h', in the "
            "frame or at the top of the file",
        )
    cx, cy = _number(values, "cx"), _number(values, "cy")
    if size is None and (cx is None or cy is None):
        raise _UnreadableError("neither 'cx' and 'cy' nor 'w' and 'h' are given", "add either pair")
    height, width = size or (0, 0)
    return fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy


def _from_angle(angle: float | None, size: Size | None, axis: int) -> float | None:
    if angle is None or size is None or not 0 < angle < math.pi:
        return None
    return size[axis] / 2 / math.tan(angle / 2)


def _lens(values: Mapping[str, Any]) -> Lens | None:
    model = values.get("camera_model", "PINHOLE")
    fisheye = model in _FISHEYE or bool(values.get("is_fisheye"))
    if model not in _PINHOLE and not fisheye:
        known = ", ".join(sorted((*_PINHOLE, *_FISHEYE)))
        raise _UnreadableError(
            f"the camera model {model!r} is not known", f"{_UNDISTORT}, or export one of {known}"
        )
    for key in (*_OTHER, *(() if fisheye else ("k4",))):
        if _coefficient(values, key):
            raise _UnreadableError(
                f"{key!r} is set, which belongs to another camera model",
                f"{_UNDISTORT}, or export without it",
            )
    if fisheye:
        return Fisheye(*(_coefficient(values, key) for key in ("k1", "k2", "k3", "k4")))
    return bending(RadialTangential(*(_coefficient(values, key) for key in _RADIAL_TANGENTIAL)))


def _coefficient(values: Mapping[str, Any], key: str) -> float:
    """A distortion coefficient; 0 where it is absent or null."""
    if values.get(key) is None:
        return 0.0
    number = _number(values, key)
    if number is None or not math.isfinite(number):
        raise _UnreadableError(
            f"the distortion {key!r} must be a finite number, got {values[key]!r}", "correct it"
        )
    return number


def _with_splits(frames: Sequence[PhotoFrame], data: Mapping[str, Any]) -> list[PhotoFrame]:
    """`frames` with the split that nerfstudio's 'train_filenames' and its like give them.

    Validation photos are test photos too. With one kind of list, the other frames are of the other
    kind; with both, frames that no list names are unused.
    """
    train = _listed(data, "train_filenames", frames)
    test = _listed(data, "test_filenames", frames) | _listed(data, "val_filenames", frames)
    if not train and not test:
        return list(frames)
    rest = "unused" if train and test else "test" if train else "train"
    return [
        replace(
            frame,
            split="train" if frame.name in train else "test" if frame.name in test else rest,
        )
        for frame in frames
    ]


def _listed(data: Mapping[str, Any], key: str, frames: Sequence[PhotoFrame]) -> set[str]:
    names = data.get(key) or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{key!r} must be a list of file names, got {names!r}")
    listed = {image_name(name) for name in names}
    unknown = sorted(listed - {frame.name for frame in frames})
    if unknown:
        raise ValueError(
            f"{key!r} names {unknown[0]}, which no frame has: add the frame, or remove the name"
        )
    return listed

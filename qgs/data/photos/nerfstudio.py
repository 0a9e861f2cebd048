"""nerfstudio's `transforms.json`, and files of the same schema: Blender's, DL3DV's."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import PurePosixPath
from typing import Any, TypeVar

import numpy as np
from PIL import Image
from upath import UPath

from qgs.data.images import image_size
from qgs.data.lenses import Fisheye, Intrinsics, Lens, RadialTangential, Size, bending
from qgs.data.photos.checks import FrameProblem, listed_size
from qgs.data.photos.reader import (
    Listing,
    PhotoFrame,
    PhotoReader,
    existing,
    numbers,
    with_images,
)
from qgs.paths import read_json

Value = TypeVar("Value")

_REDUCED = ("images_2", "images_4", "images_8")
_PINHOLE = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = "OPENCV_FISHEYE"
_OTHER = ("k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y", "sx1", "sy1", "b1", "b2")
_NO_POSE = np.full((4, 4), np.nan)
_NO_INTRINSICS: Intrinsics = (math.nan, math.nan, math.nan, math.nan)
_OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0, 1.0])  # of a pose's columns


class Nerfstudio(PhotoReader):
    """`transforms.json` with masks, depth, splits; reduced copies if all photos are missing."""

    name = "nerfstudio"
    listing = "transforms.json"
    poses = "opengl"

    @classmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """See `PhotoReader`: the frames in the file's order."""
        file = folder / cls.listing
        frames = read_transforms(file)
        if images is not None:
            return Listing(file, with_images(frames, folder, images))
        top = {PurePosixPath(frame.name).parts[:1] for frame in frames}
        if top == {("images",)} and not (folder / "images").is_dir():
            # DL3DV ships reduced copies alone, under the listing of the full size
            for copy in _REDUCED:
                if (folder / copy).is_dir():
                    moved = with_images(frames, folder, copy)
                    if existing(frame.path for frame in moved):
                        return Listing(file, moved)
        return Listing(file, frames)


def read_transforms(file: UPath) -> list[PhotoFrame]:
    """The frames of a transforms file in order, with their faults in them. Raises ValueError."""
    data = read_json(file, "export it again")
    entries = data.get("frames") if isinstance(data, Mapping) else None
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{file} lists no frames: expected a non-empty list under 'frames'")
    folder = file.parent
    frames = [_frame(folder, data, entry, None) for entry in entries]
    try:
        # an angle of view needs the image's size; a header is read only where nothing lists one
        if any(frame.problems and not frame.size for frame in frames):
            present = existing(frame.path for frame in frames)
            first = next((frame.path for frame in frames if frame.path in present), None)
            size = image_size(first) if first else None
            frames = [_frame(folder, data, entry, size) for entry in entries]
        return _with_splits(frames, data)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


class _UnreadableError(Exception):
    """A value of a frame that cannot be read. Arguments: field of `PhotoFrame`, reason, fix."""


def _frame(folder: UPath, data: Mapping[str, Any], entry: Any, size: Size | None) -> PhotoFrame:
    """size: (H, W) of the image where neither the frame nor the top of `data` gives 'h' and 'w'."""
    path = entry.get("file_path") if isinstance(entry, Mapping) else None
    if not isinstance(path, str) or not PurePosixPath(path).name or "://" in path:
        problem = FrameProblem("path", "its 'file_path' names no file", "correct or remove it")
        return PhotoFrame("", folder, _NO_POSE, _NO_INTRINSICS, problems=(problem,))
    values = {**data, **entry}
    name = image_name(path)
    height, width = (_number(values, key) for key in ("h", "w"))
    given, wrong = (
        listed_size(height, width) if height is not None and width is not None else (None, ())
    )
    size, problems = given or size, [*wrong]

    def read(value: Callable[[], Value], otherwise: Value) -> Value:
        try:
            return value()
        except _UnreadableError as error:
            problems.append(FrameProblem(*error.args))
            return otherwise

    mask, depth = (entry.get(key) for key in ("mask_path", "depth_file_path"))
    return PhotoFrame(
        name=name,
        path=folder / name,
        c2w=read(lambda: _pose(entry), _NO_POSE),
        intrinsics=read(lambda: _intrinsics(values, size), _NO_INTRINSICS),
        size=size,
        lens=read(lambda: _lens(values), None),
        mask=folder / mask if isinstance(mask, str) and mask else None,
        depth=folder / depth if isinstance(depth, str) and depth else None,
        time=read(lambda: _finite(entry, "time", "time"), None),
        problems=tuple(problems),
    )


def image_name(file_path: str) -> str:
    """`file_path` in one spelling; one without an image's suffix, as in Blender's sets, is PNG."""
    name = PurePosixPath(file_path.replace("\\", "/"))
    suffix = name.suffix.lower()
    known = suffix[1:].isalpha() or suffix in Image.registered_extensions()
    return str(name if known else name.with_name(f"{name.name}.png"))


def _pose(entry: Mapping[str, Any]) -> np.ndarray:
    """OpenGL to OpenCV: the camera's y and z axes change sign."""
    c2w = numbers(entry.get("transform_matrix"))
    if c2w.shape == (3, 4):
        c2w = np.vstack([c2w, [0, 0, 0, 1]])
    if c2w.shape != (4, 4):
        reason = "'transform_matrix' must be 4 x 4 numbers"
        raise _UnreadableError("c2w", reason, "export the pose again")
    return c2w * _OPENGL_TO_OPENCV


def _number(values: Mapping[str, Any], key: str) -> float | None:
    """A number, NaN included; None where it is absent, null or something else."""
    value = values.get(key)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _intrinsics(values: Mapping[str, Any], size: Size | None) -> Intrinsics:
    def focal(key: str, angle_key: str, axis: int) -> float | None:
        """In pixels, as given or from the angle of view."""
        angle = _number(values, angle_key)
        if angle is None or size is None or not 0 < angle < math.pi:
            return _number(values, key) or None
        return _number(values, key) or size[axis] / 2 / math.tan(angle / 2)

    fx = focal("fl_x", "camera_angle_x", 1)
    fy = focal("fl_y", "camera_angle_y", 0) or fx  # pixels are square unless listed
    if fx is None or fy is None:
        raise _UnreadableError(
            "intrinsics",
            "there is no focal length",
            "expected 'fl_x' (pixels), or 'camera_angle_x' (radians) with 'w' and 'h', in the "
            "frame or at the top of the file",
        )
    cx, cy = _number(values, "cx"), _number(values, "cy")
    if size is None and (cx is None or cy is None):
        reason = "neither 'cx' and 'cy' nor 'w' and 'h' are given"
        raise _UnreadableError("intrinsics", reason, "add either pair")
    height, width = size or (0, 0)
    return fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy


def _lens(values: Mapping[str, Any]) -> Lens | None:
    model = values.get("camera_model", "PINHOLE")
    fisheye = model == _FISHEYE or bool(values.get("is_fisheye"))
    if model not in _PINHOLE and not fisheye:
        known = ", ".join(sorted((*_PINHOLE, _FISHEYE)))
        fix = f"undistort the photos first, or export one of {known}"
        raise _UnreadableError("lens", f"the camera model {model!r} is not known", fix)
    # an ignored coefficient would shift pixels against the poses without an error
    for key in _OTHER if fisheye else (*_OTHER, "k4"):
        if _finite(values, key, "lens"):
            reason = f"{key!r} is set, which belongs to another camera model"
            fix = "undistort the photos first, or export without it"
            raise _UnreadableError("lens", reason, fix)
    kind = Fisheye if fisheye else RadialTangential
    names = (field.name for field in fields(kind))
    return bending(kind(**{name: _finite(values, name, "lens") or 0.0 for name in names}))


def _finite(values: Mapping[str, Any], key: str, field: str) -> float | None:
    """A number for a `field` of `PhotoFrame`; None where it is absent or null."""
    if values.get(key) is None:
        return None
    number = _number(values, key)
    if number is None or not math.isfinite(number):
        reason = f"{key!r} must be a finite number, got {values[key]!r}"
        raise _UnreadableError(field, reason, "correct it")
    return number


def _with_splits(frames: Sequence[PhotoFrame], data: Mapping[str, Any]) -> list[PhotoFrame]:
    """`frames` with nerfstudio's splits: val is test; unnamed ones are the other, or unused."""
    known = {frame.name for frame in frames}
    splits: dict[str, set[str]] = {"train": set(), "test": set()}
    for part, split in (("train", "train"), ("test", "test"), ("val", "test")):
        key = f"{part}_filenames"
        given = data.get(key) or []
        if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
            raise ValueError(f"{key!r} must be a list of file names, got {given!r}")
        names = set(map(image_name, given))
        if unknown := sorted(names - known):
            raise ValueError(f"{key!r} names {unknown[0]}, which no frame has: remove the name")
        splits[split] |= names
    train, test = splits["train"], splits["test"]
    rest = ("unused" if test else "test") if train else ("train" if test else None)
    return [
        replace(f, split="train" if f.name in train else "test" if f.name in test else rest)
        for f in frames
    ]

"""nerfstudio's `transforms.json`: which photos there are and where they were taken.

Poses in the file are OpenGL camera-to-world (x right, y up, z backward); here they become OpenCV.
`applied_transform`, which tells how the exporter moved the world, is left as it is: the world is
the one that the poses are given in.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

_log = logging.getLogger(__name__)

FILE = "transforms.json"
_PINHOLE = {"PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"}
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_UNKNOWN_DISTORTION = (
    "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y", "sx1", "sy1", "b1", "b2",
)  # fmt: skip
_IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff"}
_TOLERANCE = 1e-3  # of rotations against orthonormality


@dataclass(frozen=True)
class PhotoFrame:
    """One frame of the file.

    c2w: (4, 4) OpenCV camera-to-world. intrinsics: fx, fy, cx, cy in pixels of an image of `size`
    (H, W). distortion: k1, k2, p1, p2, k3 of the OpenCV model; all 0 for a pinhole.
    """

    path: Path
    c2w: np.ndarray
    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int] | None
    distortion: tuple[float, ...]


def read_transforms(folder: Path) -> list[PhotoFrame]:
    """The frames of `folder`/transforms.json, in the file's order; image files are not opened.

    Neighbours in the file should be neighbours in space, as exporters write them: inputs and
    targets are drawn from spans of it. Masks ('mask_path') are not used, which is logged.
    Raises FileNotFoundError when there is no such file, ValueError for what it cannot mean.
    """
    path = _find(folder)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid JSON: {error}; export it again") from error
    frames = data.get("frames") if isinstance(data, Mapping) else None
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{path} lists no frames: expected a non-empty list under 'frames'")
    result = [_frame(path, i, data, frame) for i, frame in enumerate(frames)]
    masked = sum(bool(frame.get("mask_path")) for frame in frames)
    if masked:
        _log.warning(
            "%d of %d frames of %s have a 'mask_path', and masks are not used: what they hide is "
            "learnt like the rest", masked, len(frames), path,
        )  # fmt: skip
    return result


def _find(folder: Path) -> Path:
    if not folder.is_dir():
        raise FileNotFoundError(
            f"photo folder {folder} (from {Path.cwd()}) does not exist or is no folder: give the "
            f"folder that holds {FILE}"
        )
    path = folder / FILE
    if path.is_file():
        return path
    inside = sorted(item.name for item in folder.iterdir())
    images = sum(Path(name).suffix.lower() in _IMAGE_SUFFIXES for name in inside)
    listed = ", ".join(inside[:8]) + (", ..." if len(inside) > 8 else "") or "nothing"
    raise FileNotFoundError(
        f"{folder} has no {FILE}; it holds {listed} ({images} images). Camera poses are needed: "
        "make the file with nerfstudio's `ns-process-data`, or give the folder that holds it"
    )


def _frame(path: Path, index: int, data: Mapping[str, Any], frame: Any) -> PhotoFrame:
    if not isinstance(frame, Mapping) or not isinstance(frame.get("file_path"), str):
        raise ValueError(f"{path}: frame {index} has no 'file_path'")
    where = f"{path}: frame {index} ({frame['file_path']})"
    values = {**data, **frame}
    return PhotoFrame(
        path=_image_path(path.parent, frame["file_path"]),
        c2w=_pose(where, frame),
        intrinsics=_intrinsics(where, values),
        size=_size(values),
        distortion=_distortion(where, values),
    )


def _image_path(folder: Path, name: str) -> Path:
    """The image file; a name without suffix, as in Blender's sets, means PNG."""
    path = folder / name
    return path if path.suffix else path.with_suffix(".png")


def _pose(where: str, frame: Mapping[str, Any]) -> np.ndarray:
    """OpenGL to OpenCV: the camera's y and z axes change sign."""
    try:
        c2w = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        c2w = np.zeros(0)
    if c2w.shape == (3, 4):
        c2w = np.vstack([c2w, [0, 0, 0, 1]])
    if c2w.shape != (4, 4):
        raise ValueError(f"{where}: 'transform_matrix' must be 4 x 4 numbers")
    if not np.isfinite(c2w).all():
        raise ValueError(
            f"{where}: 'transform_matrix' has NaN or infinite numbers: remove the frame"
        )
    rotation = c2w[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    determinant = float(np.linalg.det(rotation))
    if error > _TOLERANCE or determinant < 0 or np.abs(c2w[3] - [0, 0, 0, 1]).max() > _TOLERANCE:
        raise ValueError(
            f"{where}: 'transform_matrix' is not rigid (rotation off by {error:.2g}, determinant "
            f"{determinant:.3g}, last row {c2w[3].tolist()}): poses must rotate and translate only"
        )
    return c2w @ np.diag([1.0, -1.0, -1.0, 1.0])


def _number(values: Mapping[str, Any], key: str) -> float | None:
    value = values.get(key)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def _size(values: Mapping[str, Any]) -> tuple[int, int] | None:
    height, width = _number(values, "h"), _number(values, "w")
    return (int(height), int(width)) if height and width else None


def _intrinsics(where: str, values: Mapping[str, Any]) -> tuple[float, float, float, float]:
    size = _size(values)
    fx = _number(values, "fl_x") or _from_angle(_number(values, "camera_angle_x"), size, 1)
    fy = _number(values, "fl_y") or _from_angle(_number(values, "camera_angle_y"), size, 0) or fx
    if fx is None or fy is None or fx <= 0 or fy <= 0:
        raise ValueError(
            f"{where}: no focal length: expected 'fl_x' (pixels), or 'camera_angle_x' (radians) "
            "with 'w' and 'h', in the frame or at the top of the file"
        )
    cx, cy = _number(values, "cx"), _number(values, "cy")
    if size is None and (cx is None or cy is None):
        raise ValueError(f"{where}: neither 'cx' and 'cy' nor 'w' and 'h' are given")
    height, width = size or (0, 0)
    return fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy


def _from_angle(angle: float | None, size: tuple[int, int] | None, axis: int) -> float | None:
    if angle is None or size is None or not 0 < angle < math.pi:
        return None
    return size[axis] / 2 / math.tan(angle / 2)


def _distortion(where: str, values: Mapping[str, Any]) -> tuple[float, ...]:
    model = values.get("camera_model", "PINHOLE")
    if model not in _PINHOLE or values.get("is_fisheye"):
        name = "fisheye" if values.get("is_fisheye") else model
        raise ValueError(
            f"{where}: the camera model {name!r} bends rays in a way that no pinhole camera can "
            f"undo: undistort the photos first, or export one of {', '.join(sorted(_PINHOLE))}"
        )
    for key in _UNKNOWN_DISTORTION:
        if _coefficient(where, values, key):
            raise ValueError(
                f"{where}: {key!r} is set, which belongs to fisheye lenses or to OpenCV's larger "
                "models: undistort the photos first, or export without it"
            )
    return tuple(_coefficient(where, values, key) for key in _DISTORTION)


def _coefficient(where: str, values: Mapping[str, Any], key: str) -> float:
    """A distortion coefficient; 0 where it is absent or null."""
    if values.get(key) is None:
        return 0.0
    number = None if isinstance(values[key], bool) else _number(values, key)
    if number is None:
        raise ValueError(
            f"{where}: the distortion {key!r} must be a finite number, got {values[key]!r}"
        )
    return number

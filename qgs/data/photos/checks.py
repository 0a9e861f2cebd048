"""Problems of a listed photo: its pose, its intrinsics, its size."""

import math
import os
from collections.abc import Iterator, Sequence

import numpy as np
from upath import UPath

from qgs.data.lenses import Intrinsics, Size
from qgs.data.photos.reader import FrameProblem, Listing, PhotoFrame
from qgs.wording import listed, name_shown, numbered, warn_once

# Pixels of a listed photo.
LARGEST_SIDE = 10**6
# Largest coordinate of a camera: the square of larger ones overflows float32.
_FARTHEST = 1e12
# Tolerance of rotations against orthonormality.
_RIGID = 1e-3
# Relative difference between the file's and the listing's aspect ratio.
_SAME_ASPECT = 0.01
# Ratio of fx and fy up to which pixels are about square.
_SQUARE = 1.4
# Of a side, of the principal point from the middle.
_OFF_CENTRE = 0.3
# A focal length below is in units of the image, not of its pixels.
_NORMALISED = 5.0
# Focal lengths per longer side: angles of view of 157 and 2 degrees.
_FOCAL = (0.1, 30.0)


def refuse_outside(folder: UPath, found: Listing) -> None:
    """Raise ValueError for a listed file that is not in `folder`; a link there is."""
    for frame in found.frames:
        for file in filter(None, (frame.path, frame.mask, frame.depth)):
            if os.path.relpath(file.path, folder.path or ".").split(os.sep)[0] == "..":
                raise ValueError(
                    f"{found.file} names {name_shown(str(file))}, which is outside of {folder}: "
                    "move it into the folder, or train with data.outside=true"
                )


def pose_problems(c2w: np.ndarray) -> Iterator[FrameProblem]:
    """Yield problems of a pose (4, 4): NaN, mirrored, sheared or scaled."""
    # NaN is not at most anything.
    if not np.abs(c2w).max() <= _FARTHEST:
        reason = f"the pose has NaN or numbers larger than {_FARTHEST:.0e}"
        yield FrameProblem(reason, "correct it, or remove the frame")
        return
    # Mirrored is told from sheared: the remedies differ.
    rotation = c2w[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > _RIGID or np.abs(c2w[3] - [0, 0, 0, 1]).max() > _RIGID:
        yield FrameProblem(
            f"the pose is not rigid (rotation off by {error:.2g}, last row {c2w[3].tolist()})",
            "poses must rotate and translate only; divide the rotation by its scale",
        )
    elif np.linalg.det(rotation) < 0:
        fix = "negate one axis of the camera, or export the poses again"
        yield FrameProblem("the pose mirrors and so is not rigid", fix)


def intrinsics_problems(intrinsics: Intrinsics, size: Size | None) -> Iterator[FrameProblem]:
    """Yield problems of fx, fy, cx, cy in pixels of `size` (H, W); not all are fatal."""
    fx, fy, cx, cy = intrinsics
    values = f"(fx {fx:.6g}, fy {fy:.6g}, cx {cx:.6g}, cy {cy:.6g})"
    if not all(map(math.isfinite, intrinsics)) or fx <= 0 or fy <= 0:
        reason = f"intrinsics are not finite, or focal lengths not positive {values}"
        yield FrameProblem(reason, "export the intrinsics again")
        return
    in_pixels = size is not None and max(size) > 20 * _NORMALISED
    if max(fx, fy) < _NORMALISED and (in_pixels or max(abs(cx), abs(cy)) <= 1):
        fix = "they must be in pixels; multiply fx and cx by the width, fy and cy by the height"
        yield FrameProblem(f"the intrinsics look normalised {values}", fix)
        return
    if size is None:
        return
    height, width = size
    nearest, farthest = (limit * max(size) for limit in _FOCAL)
    off_centre = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
    plausible = nearest <= min(fx, fy) and max(fx, fy) <= farthest and off_centre <= _OFF_CENTRE
    if not plausible or not 1 / _SQUARE < fx / fy < _SQUARE:
        yield FrameProblem(
            f"the intrinsics {values} are implausible for {width} x {height} pixels",
            "correct them, unless the photo is cut from a larger one; fx and cx go with the width, "
            "fy and cy with the height",
            fatal=False,
        )


def size_problems(size: Size, listed: Size | None) -> Iterator[FrameProblem]:
    """Yield problems of an image file of `size` (H, W); a scaled copy of `listed` has none."""
    if listed is None or _alike(size, listed):
        return
    swapped = _alike(size, (listed[1], listed[0]))
    yield FrameProblem(
        f"the image is {size[1]} x {size[0]} pixels, but listed as {listed[1]} x {listed[0]}, "
        "another aspect ratio, so that the intrinsics cannot be scaled",
        "width and height are swapped; swap them back, or turn the photos' pixels where EXIF does "
        "(`mogrify -auto-orient`)"
        if swapped
        else "give the original image, or correct the listed size",
    )


def _alike(size: Size, other: Size) -> bool:
    """Return whether two sizes have about the same aspect ratio."""
    return abs(size[1] * other[0] / (size[0] * other[1]) - 1) <= _SAME_ASPECT


def listed_size(height: float, width: float) -> tuple[Size | None, tuple[FrameProblem, ...]]:
    """Return the listed size (H, W); None, and the problem, where no photo can have it."""
    if all(1 <= side <= LARGEST_SIDE for side in (height, width)):
        return (round(height), round(width)), ()
    size = f"{str(width)[:12]} x {str(height)[:12]}"
    reason = f"the listed size, {size} pixels, is impossible for a photo"
    return None, (FrameProblem(reason, "correct the width and height"),)


def refuse_fatal_problems(listing: object, frames: Sequence[PhotoFrame]) -> None:
    """Raise ValueError for the first fatal problem, with its frame; log the others."""
    doubtful: list[str] = []
    for index, frame in enumerate(frames):
        problems = frame.problems or (
            *pose_problems(frame.c2w),
            *intrinsics_problems(frame.intrinsics, frame.size),
        )
        where = f"frame {numbered(index, frame.name)}"
        for problem in problems:
            if problem.fatal:
                raise ValueError(f"{listing}: {where}: {problem}")
        if problems:
            doubtful.append(f"{where}: {problems[0]}")
    if doubtful:
        shown = listed(doubtful, 3, "; ")
        warn_once(f"{listing}: {len(doubtful)} of {len(frames)} frames are doubtful: {shown}")

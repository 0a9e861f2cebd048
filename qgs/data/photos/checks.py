"""Problems of a listed photo: its pose, its intrinsics, its size."""

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace

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
# Relative difference of sides, or of fx and fy, that counts as equal.
_SQUARE = 0.1
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
    if not np.isfinite(c2w).all():
        yield FrameProblem("c2w", "the pose has NaN or infinite numbers", "remove the frame")
        return
    if np.abs(c2w).max() > _FARTHEST:
        reason = f"the pose has a number larger than {_FARTHEST:.0e}"
        yield FrameProblem("c2w", reason, "correct it, or remove the frame")
        return
    # Mirrored is told from sheared: the remedies differ.
    rotation = c2w[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    determinant = float(np.linalg.det(rotation))
    if error <= _RIGID and determinant < 0:
        yield FrameProblem(
            "c2w",
            f"the pose mirrors and so is not rigid (determinant {determinant:.3g})",
            "negate one axis of the camera, or export the poses again",
        )
    elif error > _RIGID or np.abs(c2w[3] - [0, 0, 0, 1]).max() > _RIGID:
        yield FrameProblem(
            "c2w",
            f"the pose is not rigid (rotation off by {error:.2g}, determinant {determinant:.3g}, "
            f"last row {c2w[3].tolist()})",
            "poses must rotate and translate only; divide the rotation by its scale",
        )


def intrinsics_problems(intrinsics: Intrinsics, size: Size | None) -> Iterator[FrameProblem]:
    """Yield problems of fx, fy, cx, cy in pixels of `size` (H, W); not all are fatal."""

    def problem(reason: str, fix: str, *, fatal: bool = True) -> FrameProblem:
        values = f"fx {fx:.6g}, fy {fy:.6g}, cx {cx:.6g}, cy {cy:.6g}"
        pixels = "" if size is None or fatal else f", {size[1]} x {size[0]} pixels"
        return FrameProblem("intrinsics", f"{reason} ({values}{pixels})", fix, fatal)

    fx, fy, cx, cy = intrinsics
    if not all(map(math.isfinite, intrinsics)) or fx <= 0 or fy <= 0:
        fix = "export the intrinsics again"
        yield problem("intrinsics are not finite, or focal lengths not positive", fix)
        return
    in_pixels = size is not None and max(size) > 20 * _NORMALISED
    if max(fx, fy) < _NORMALISED and (in_pixels or max(abs(cx), abs(cy)) <= 1):
        fix = "they must be in pixels; multiply fx and cx by the width, fy and cy by the height"
        yield problem("the intrinsics look normalised", fix)
        return
    if size is None:
        return
    height, width = size
    if not (0 < cx < width and 0 < cy < height):
        fix = "correct cx and cy, unless the photo is cut from a larger one"
        yield problem("the principal point lies off the image", fix, fatal=False)
    aspect = width / height
    # fx / fy is the square of the aspect ratio where the sides of square pixels were swapped.
    if abs(aspect - 1) > _SQUARE and abs(fx / fy / aspect**2 - 1) < _SQUARE:
        yield problem(
            "fx and fy differ as if divided by the wrong side of the image",
            "width and height are swapped; divide fx and cx by the width, fy and cy by the height",
            fatal=False,
        )
        return
    nearest, farthest = (limit * max(size) for limit in _FOCAL)
    if min(fx, fy) < nearest or max(fx, fy) > farthest or not 0.5 < fx / fy < 2:
        fix = "correct them, or the size that goes with them"
        yield problem("the focal lengths are implausible", fix, fatal=False)


def size_problems(size: Size, listed: Size | None) -> Iterator[FrameProblem]:
    """Yield problems of an image file of `size` (H, W); a scaled copy of `listed` has none."""
    if listed is None or _alike(size, listed):
        return
    if _alike(size, (listed[1], listed[0])):
        fix = (
            "width and height are swapped; swap them back, or turn the photos' pixels where EXIF "
            "does (`mogrify -auto-orient`)"
        )
    else:
        fix = "give the original image, or correct the listed size"
    yield FrameProblem(
        "size",
        f"the image is {size[1]} x {size[0]} pixels, but listed as {listed[1]} x {listed[0]}, "
        "another aspect ratio, so that the intrinsics cannot be scaled",
        fix,
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
    return None, (FrameProblem("size", reason, "correct the width and height"),)


def with_equal_times(listing: Listing) -> Listing:
    """Return `listing`, with a problem for each frame that lacks the time that others have."""
    count = len(listing.frames)
    without = sum(frame.time is None for frame in listing.frames)
    if without in (0, count):
        return listing
    reason = f"it has no 'time', like {without} of {count} frames, and the others have"
    problem = FrameProblem("time", reason, "write it for each, or for none where nothing moves")
    frames = [
        replace(frame, problems=frame.problems or (problem,)) if frame.time is None else frame
        for frame in listing.frames
    ]
    return replace(listing, frames=frames)


def frame_problems(frame: PhotoFrame) -> Iterator[FrameProblem]:
    """Yield all problems of `frame` as listed; its image is not opened."""
    yield from frame.problems
    if not frame.problems:
        yield from pose_problems(frame.c2w)
        yield from intrinsics_problems(frame.intrinsics, frame.size)


def refuse_fatal_problems(listing: object, frames: Sequence[PhotoFrame]) -> None:
    """Raise ValueError for the first fatal problem, with its frame; log the others."""
    doubtful: list[str] = []
    for index, frame in enumerate(frames):
        problems = list(frame_problems(frame))
        where = f"frame {numbered(index, frame.name)}"
        for problem in problems:
            if problem.fatal:
                raise ValueError(f"{listing}: {where}: {problem}")
        if problems:
            doubtful.append(f"{where}: {problems[0]}")
    if doubtful:
        shown = listed(doubtful, 3, "; ")
        warn_once(f"{listing}: {len(doubtful)} of {len(frames)} frames are doubtful: {shown}")

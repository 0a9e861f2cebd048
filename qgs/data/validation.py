"""Judgements of listed photos: readers raise what they find, `qgs data check` reports it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from qgs.data.frames import Fault, Intrinsics, PhotoFrame, Size
from qgs.data.notices import warn_once

_RIGID = 1e-3  # of rotations against orthonormality
_SAME_ASPECT = 0.01  # relative difference between the file's and the listing's aspect ratio
_SQUARE = 0.1  # relative difference of sides, or of fx and fy, that is none
_NORMALISED = 5.0  # a focal length below is in units of the image, not of its pixels
_FOCAL = (0.1, 30.0)  # of the longer side: angles of view of 157 and 2 degrees


def pose_faults(c2w: np.ndarray) -> Iterator[Fault]:
    """What is wrong with a pose (4, 4): NaN, mirrored, sheared or scaled."""
    if not np.isfinite(c2w).all():
        yield Fault("the pose has NaN or infinite numbers", "remove the frame")
        return
    rotation = c2w[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    determinant = float(np.linalg.det(rotation))
    if error <= _RIGID and determinant < 0:
        yield Fault(
            f"the pose mirrors and so is not rigid (determinant {determinant:.3g})",
            "negate one axis of the camera, or export the poses again",
        )
    elif error > _RIGID or np.abs(c2w[3] - [0, 0, 0, 1]).max() > _RIGID:
        yield Fault(
            f"the pose is not rigid (rotation off by {error:.2g}, determinant {determinant:.3g}, "
            f"last row {c2w[3].tolist()})",
            "poses must rotate and translate only; divide the rotation by its scale",
        )


def intrinsics_faults(intrinsics: Intrinsics, size: Size | None) -> Iterator[Fault]:
    """What is wrong with fx, fy, cx, cy in pixels of an image of `size` (H, W), where it is known.

    Fatal where they cannot be pixels at all; a principal point off the image and a strange angle
    of view may be right, and are told only.
    """
    fx, fy, cx, cy = intrinsics
    said = f"fx {fx:.6g}, fy {fy:.6g}, cx {cx:.6g}, cy {cy:.6g}"
    if not all(map(math.isfinite, intrinsics)) or fx <= 0 or fy <= 0:
        fix = "focal lengths must be positive; export the intrinsics again"
        yield Fault(f"intrinsics are no numbers of a camera ({said})", fix)
        return
    in_pixels = size is not None and max(size) > 20 * _NORMALISED
    if max(fx, fy) < _NORMALISED and (in_pixels or max(abs(cx), abs(cy)) <= 1):
        yield Fault(
            f"the intrinsics look normalised ({said})",
            "they must be in pixels; multiply fx and cx by the width, fy and cy by the height",
        )
        return
    if size is None:
        return
    height, width = size
    if not (0 < cx < width and 0 < cy < height):
        yield Fault(
            f"the principal point lies off the image ({said}, {width} x {height} pixels)",
            "correct cx and cy, unless the photo is cut from a larger one",
            fatal=False,
        )
    focal = [f / max(size) for f in (fx, fy)]
    if _divided_by_wrong_side(fx / fy, width / height):
        yield Fault(
            f"fx and fy differ as if divided by the wrong side of the image ({said}, {width} x "
            f"{height} pixels)",
            "width and height are swapped; divide fx and cx by the width, fy and cy by the height",
            fatal=False,
        )
    elif min(focal) < _FOCAL[0] or max(focal) > _FOCAL[1] or not 0.5 < fx / fy < 2:
        yield Fault(
            f"the focal lengths are implausible ({said}, {width} x {height} pixels)",
            "correct them, or the size that goes with them",
            fatal=False,
        )


def _divided_by_wrong_side(ratio: float, aspect: float) -> bool:
    """Whether fx / fy is what square pixels give when width and height have been swapped."""
    return abs(aspect - 1) > _SQUARE and abs(ratio / aspect**2 - 1) < _SQUARE


def size_faults(size: Size, listed: Size | None) -> Iterator[Fault]:
    """What is wrong with an image file of `size` (H, W) listed with another one.

    A scaled copy is right: intrinsics follow its size.
    """
    if listed is None:
        return
    ratio = size[1] * listed[0] / (size[0] * listed[1])
    if abs(ratio - 1) <= _SAME_ASPECT:
        return
    swapped = abs(size[1] * listed[1] / (size[0] * listed[0]) - 1) <= _SAME_ASPECT
    yield Fault(
        f"the image is {size[1]} x {size[0]} pixels, but listed as {listed[1]} x {listed[0]}, "
        "another aspect ratio, so that the intrinsics cannot be scaled",
        "width and height are swapped; swap them back" if swapped
        else "give the original image, or correct the listed size",
    )  # fmt: skip


def frame_faults(frame: PhotoFrame) -> Iterator[Fault]:
    """Everything that is wrong with `frame` as listed, without opening its image."""
    yield from frame.faults
    if not frame.faults:
        yield from pose_faults(frame.c2w)
        yield from intrinsics_faults(frame.intrinsics, frame.size)


def require_sound(listing: object, frames: Sequence[PhotoFrame]) -> None:
    """Raise ValueError for the first frame of `listing` that has a fatal fault, naming both.

    Of other faults, the first is logged, with the number of frames that have any.
    """
    doubtful: list[str] = []
    for index, frame in enumerate(frames):
        faults = list(frame_faults(frame))
        name = f" ({frame.name})" if frame.name else ""
        for fault in faults:
            if fault.fatal:
                raise ValueError(f"{listing}: frame {index}{name}: {fault}")
        doubtful += [f"frame {index}{name}: {faults[0]}"] if faults else []
    if doubtful:
        warn_once(
            f"{listing}: {len(doubtful)} of {len(frames)} frames are doubtful, first {doubtful[0]}"
        )

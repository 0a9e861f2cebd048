"""LLFF: `poses_bounds.npy` beside a folder of photos (Mildenhall et al., 2019)."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from upath import UPath

from qgs.data.photos.frames import PhotoFrame
from qgs.data.photos.reading import IMAGE_SUFFIXES, Listing, image_folder

LISTING = "poses_bounds.npy"
_FEW = 5


def recognises(folder: UPath) -> bool:
    """Whether `folder` holds this format."""
    return (folder / LISTING).is_file()


def read(folder: UPath, images: str | None) -> Listing:
    """The photos by name, each with its row: 15 numbers of a (3, 5) matrix, near and far.

    The matrix is a camera-to-world whose axes are (down, right, back), then height, width and focal
    length; the principal point is the middle. Near and far are not used.
    Raises ValueError unless there are as many photos as rows.
    """
    file = folder / LISTING
    rows = _rows(file)
    photos = image_folder(folder, images)
    paths = sorted(
        (
            item
            for item in photos.iterdir()
            if item.name.lower().endswith(IMAGE_SUFFIXES) and not item.name.startswith(".")
        ),
        key=lambda item: item.name,
    )
    if len(paths) != len(rows):
        raise ValueError(
            f"{file} has {len(rows)} poses, but {photos} has {len(paths)} images: they belong "
            f"together in the order of the names{_skipped(paths)}, so give all images and no others"
        )
    return Listing(file, [_frame(path, row) for path, row in zip(paths, rows, strict=True)])


def _skipped(paths: Sequence[UPath]) -> str:
    """Which numbers the names skip, in words; empty where they count on or have no numbers."""
    numbers = [int(found[0]) for path in paths if (found := re.search(r"\d+$", path.stem))]
    if len(numbers) < max(2, len(paths)):
        return ""
    absent = sorted(set(range(min(numbers), max(numbers))) - set(numbers))
    return f" (they skip {', '.join(map(str, absent))})" if 0 < len(absent) <= _FEW else ""


def _rows(file: UPath) -> np.ndarray:
    """(N, 17) float64. Raises ValueError for a file of something else."""
    try:
        with file.open("rb") as opened:
            rows = np.load(opened, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(
            f"{file} is no NumPy file of numbers ({error}): export it again"
        ) from error
    numeric = isinstance(rows, np.ndarray) and rows.dtype.kind in "fiu"
    if not numeric or rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        shape = getattr(rows, "shape", ())
        raise ValueError(f"{file} must have shape (N, 17), got {shape}: export it again")
    return rows.astype(np.float64)


def _frame(path: UPath, row: np.ndarray) -> PhotoFrame:
    matrix = row[:15].reshape(3, 5)
    down, right, back, centre, (height, width, focal) = matrix.T
    c2w = np.eye(4)
    c2w[:3] = np.stack([right, down, -back, centre], 1)
    whole = np.isfinite([height, width]).all() and min(height, width) >= 1
    return PhotoFrame(
        name=f"{path.parent.name}/{path.name}",
        path=path,
        c2w=c2w,
        intrinsics=(float(focal), float(focal), float(width / 2), float(height / 2)),
        size=(round(height), round(width)) if whole else None,
    )

"""Base of readers of photos, and the frames that they give: poses, intrinsics, lenses, files."""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import ClassVar, Literal

import numpy as np
from upath import UPath

from qgs.data.lenses import Intrinsics, Lens, Size
from qgs.paths import listing

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
_COPY = re.compile(r"images(_\d+)?")


@dataclass(frozen=True)
class FrameProblem:
    """A fault of a `PhotoFrame`. fatal: see `refuse_fatal_problems`."""

    reason: str
    fix: str
    fatal: bool = True

    def __str__(self) -> str:
        return f"{self.reason}: {self.fix}"


@dataclass(frozen=True)
class PhotoFrame:
    """One photo as listed; nothing of it is judged yet (see `qgs.data.photos.checks`).

    name: the image file relative to the scene's folder. path: that file. mask: its mask; the image
    itself for its alpha channel. depth: its depth map. c2w: (4, 4) float64 OpenCV camera-to-world.
    intrinsics: fx, fy, cx, cy in pixels of an image of `size` (H, W), or of the file where the
    listing gives no size. lens: None for a pinhole. split: as listed, None without splits. time:
    when it was taken, in the listing's unit; None where nothing moves. turns: clockwise quarters
    from the stored pixels to those of the camera, see `qgs.data.photos.turning`.
    problems: what the listing says that cannot be read; a pose or intrinsics concerned are NaN.
    """

    name: str
    path: UPath
    c2w: np.ndarray
    intrinsics: Intrinsics
    size: Size | None = None
    lens: Lens | None = None
    mask: UPath | None = None
    depth: UPath | None = None
    split: Literal["train", "test", "unused"] | None = None
    time: float | None = None
    turns: int = 0
    problems: tuple[FrameProblem, ...] = ()

    def at_size(self, size: Size) -> Intrinsics:
        """Return intrinsics in pixels of an image of `size`, a scaled copy of what is listed."""
        height, width = self.size or size
        x = size[1] / width
        y = size[0] / height
        fx, fy, cx, cy = self.intrinsics
        return fx * x, fy * y, cx * x, cy * y


@dataclass(frozen=True)
class Listing:
    """The photos of a folder. file: what lists them. frames: in the order of the listing."""

    file: UPath
    frames: Sequence[PhotoFrame]


class PhotoReader(ABC):
    """A format that lists posed photos; subclasses are entry points of `qgs.data.photos.GROUP`."""

    name: ClassVar[str]
    """What the option `format` calls it."""

    listing: ClassVar[str]
    """The file that lists the photos, below the folder, for messages."""

    @classmethod
    def recognises(cls, folder: UPath) -> bool:
        """Return whether `folder` holds photos in this format."""
        return (folder / cls.listing).is_file()

    @classmethod
    def posed(cls, path: UPath) -> UPath | None:
        """Return a folder with cameras for `path`, photos without cameras or a video.

        It is made if need be; None where this format makes no cameras. Commands that open a user's
        photos ask for it, a training never does.
        """
        return None

    @classmethod
    @abstractmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """Read the photos that `folder` lists; neighbours in the list should be so in space.

        images: folder of photos to read instead of the listed one, such as images_4. Raises
        FileNotFoundError where it does not exist, ValueError for a listing that cannot be read.
        """


def numbers(value: object) -> np.ndarray:
    """Return nested lists as float64; an empty array for what is no array of numbers."""
    try:
        return np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)


def existing(paths: Iterable[UPath]) -> set[UPath]:
    """Return those of `paths` that exist; each folder is listed once, which object stores need."""
    names: dict[str, set[str]] = {}
    held: set[UPath] = set()
    for path in paths:
        folder = str(path.parent)
        if folder not in names:
            names[folder] = {item.name for item in listing(path.parent)}
        if path.name in names[folder]:
            held.add(path)
    return held


def image_files(folder: UPath) -> list[UPath]:
    """Return the photos in a folder, by name."""
    files = [item for item in listing(folder) if not item.name.startswith(".")]
    photos = [item for item in files if item.name.lower().endswith(IMAGE_SUFFIXES)]
    return sorted(photos, key=lambda item: item.name)


def image_folder(folder: UPath, wanted: str | None) -> UPath:
    """Return `wanted`, else images, else its least reduced copy. Raises FileNotFoundError."""
    if wanted is not None:
        chosen = folder / wanted
        if not chosen.is_dir():
            raise FileNotFoundError(f"{chosen} does not exist: correct `images`")
        return chosen
    copies = [item for item in folder.iterdir() if _COPY.fullmatch(item.name) and item.is_dir()]
    if not copies:
        raise FileNotFoundError(
            f"{folder} has neither a folder `images` nor a scaled copy such as images_4: name the "
            "folder of photos as `images`"
        )
    # `images` counts as reduced by 1.
    return min(copies, key=lambda item: int(item.name.partition("_")[2] or 1))


def with_images(
    frames: Sequence[PhotoFrame], folder: UPath, wanted: str | None
) -> list[PhotoFrame]:
    """Return `frames` with photos from the `image_folder`. Raises as that."""
    photos = image_folder(folder, wanted)
    inside = wanted or photos.name

    def moved(frame: PhotoFrame) -> PhotoFrame:
        parts = PurePosixPath(frame.name).parts
        name = str(PurePosixPath(inside, *(parts[1:] or parts)))
        mask = folder / name if frame.mask == frame.path else frame.mask
        return replace(frame, name=name, path=folder / name, mask=mask)

    return [moved(frame) if frame.name else frame for frame in frames]

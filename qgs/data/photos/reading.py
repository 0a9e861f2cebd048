"""What every reader returns, and finding image files without asking for each of them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

from upath import UPath

from qgs.data.photos.frames import PhotoFrame, Size, image_size
from qgs.data.photos.transforms import load_transforms, parse_transforms

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
_COPY = re.compile(r"images(_\d+)?")


@dataclass(frozen=True)
class Listing:
    """The photos of a folder. file: what lists them. frames: in the order of the listing."""

    file: UPath
    frames: Sequence[PhotoFrame]


def existing(paths: Iterable[UPath]) -> set[UPath]:
    """Those of `paths` that exist; each folder is listed once, which object stores need."""
    by_folder: dict[str, list[UPath]] = {}
    for path in paths:
        by_folder.setdefault(str(path.parent), []).append(path)
    held: set[UPath] = set()
    for inside in by_folder.values():
        folder = inside[0].parent
        names = {item.name for item in folder.iterdir()} if folder.is_dir() else set()
        held.update(path for path in inside if path.name in names)
    return held


def image_folder(folder: UPath, wanted: str | None) -> UPath:
    """The folder of photos: `wanted`, else images, else its least reduced copy, such as images_4.

    Raises FileNotFoundError when there is none.
    """
    if wanted is not None:
        if not (folder / wanted).is_dir():
            raise FileNotFoundError(f"{folder / wanted} does not exist: correct `images`")
        return folder / wanted
    copies = [item for item in folder.iterdir() if _COPY.fullmatch(item.name) and item.is_dir()]
    if not copies:
        raise FileNotFoundError(
            f"{folder} has neither a folder `images` nor a scaled copy such as images_4: name the "
            "folder of photos as `images`"
        )
    return min(copies, key=lambda item: int(item.name.partition("_")[2] or 1))


def with_images(frames: Sequence[PhotoFrame], folder: UPath, wanted: str) -> list[PhotoFrame]:
    """`frames` with their photos taken from `folder`/`wanted` instead of their first folder."""
    image_folder(folder, wanted)

    def moved(frame: PhotoFrame) -> PhotoFrame:
        parts = PurePosixPath(frame.name).parts
        name = str(PurePosixPath(wanted, *(parts[1:] or parts)))
        mask = folder / name if frame.mask == frame.path else frame.mask
        return replace(frame, name=name, path=folder / name, mask=mask)

    return [moved(frame) if frame.name else frame for frame in frames]


def parsed(file: UPath) -> list[PhotoFrame]:
    """The frames of a transforms file, with names relative to its folder.

    A focal length given as an angle of view needs an image size: that of the first image, where the
    file gives none. Raises as `load_transforms` and `parse_transforms`.
    """
    data, folder = load_transforms(file), file.parent
    try:
        frames = parse_transforms(data, folder)
        if all(frame.size or not frame.faults for frame in frames):
            return frames
        return parse_transforms(data, folder, _first_size([frame.path for frame in frames]))
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _first_size(paths: Sequence[UPath]) -> Size | None:
    """(H, W) of the first of `paths` that exists; None where none does."""
    present = existing(paths)
    return next((image_size(path) for path in paths if path in present), None)

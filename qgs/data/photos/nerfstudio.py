"""nerfstudio: a folder with `transforms.json`."""

from __future__ import annotations

from pathlib import PurePosixPath

from upath import UPath

from qgs.data.photos.frames import PhotoFrame
from qgs.data.photos.reading import Listing, existing, parsed, with_images

LISTING = "transforms.json"
_REDUCED = ("images_2", "images_4", "images_8")


def recognises(folder: UPath) -> bool:
    """Whether `folder` holds this format."""
    return (folder / LISTING).is_file()


def read(folder: UPath, images: str | None) -> Listing:
    """The frames in the file's order; masks ('mask_path'), depth ('depth_file_path') and splits.

    Neighbours in the file should be neighbours in space, as exporters write them: inputs and
    targets are drawn from spans of it. Where all the listed photos are missing and a reduced copy
    of their folder (images_2, _4, _8) is there, that is read.
    """
    file = folder / LISTING
    frames = parsed(file)
    if images is not None:
        return Listing(file, with_images(frames, folder, images))
    return Listing(file, _from_copy(frames, folder))


def _from_copy(frames: list[PhotoFrame], folder: UPath) -> list[PhotoFrame]:
    top = {PurePosixPath(frame.name).parts[:1] for frame in frames}
    if top != {("images",)} or (folder / "images").is_dir():
        return frames
    for copy in _REDUCED:
        if (folder / copy).is_dir():
            moved = with_images(frames, folder, copy)
            if existing(frame.path for frame in moved):
                return moved
    return frames

"""Blender (NeRF's synthetic scenes): `transforms_train.json`, `_val` and `_test`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

from upath import UPath

from qgs.data.photos.frames import PhotoFrame
from qgs.data.photos.reading import Listing, parsed

LISTING = "transforms_train.json"
_SPLITS: Mapping[str, Literal["train", "test"]] = {"train": "train", "val": "test", "test": "test"}


def recognises(folder: UPath) -> bool:
    """Whether `folder` holds this format."""
    return any(_file(folder, part).is_file() for part in _SPLITS)


def read(folder: UPath, images: str | None) -> Listing:
    """The frames of all files that exist, training first; those of the others are held out.

    The alpha channel is the mask. Raises ValueError for `images`.
    """
    if images is not None:
        raise ValueError(
            f"`images` is {images!r}, but the transforms files of {folder} name a folder for each "
            "split: leave `images` out"
        )
    frames: list[PhotoFrame] = []
    for part, split in _SPLITS.items():
        if _file(folder, part).is_file():
            frames += [replace(frame, split=split) for frame in _frames(folder, part)]
    return Listing(folder, frames)


def _file(folder: UPath, part: str) -> UPath:
    return folder / f"transforms_{part}.json"


def _frames(folder: UPath, part: str) -> list[PhotoFrame]:
    frames = parsed(_file(folder, part))
    return [replace(frame, mask=frame.mask or frame.path) for frame in frames]

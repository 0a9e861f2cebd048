"""Formats of photo folders: how each is recognised and read.

A reader is a module with `LISTING`, what makes the format, in words, `recognises(folder)` and
`read(folder, images) -> Listing`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Literal, TypeAlias

from upath import UPath

from qgs.data.lazy import warn_once
from qgs.data.photos import blender, colmap, llff, nerfstudio
from qgs.data.photos.reading import IMAGE_SUFFIXES, Listing

Format: TypeAlias = Literal["auto", "nerfstudio", "blender", "colmap", "llff"]

READERS: Mapping[str, ModuleType] = {
    "nerfstudio": nerfstudio,
    "blender": blender,
    "colmap": colmap,
    "llff": llff,
}
"""The readers by format; where a folder holds several listings, the first of this order is read."""


def formats_of(folder: UPath) -> list[str]:
    """The formats whose listings `folder` holds, in the order in which they are preferred."""
    return [name for name, reader in READERS.items() if reader.recognises(folder)]


def read_listing(folder: UPath, format: Format = "auto", images: str | None = None) -> Listing:
    """The photos that `folder` lists in `format`, or in the first of `READERS` that it holds.

    images: folder of photos to read instead of the one that the listing means, such as images_4.
    Which of several formats is read is logged. Raises FileNotFoundError for a folder that does not
    exist or lists no photos, ValueError for a listing that cannot be read.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"photo folder {folder} (from {UPath.cwd()}) does not exist or is no folder: give the "
            f"folder that holds {_listings()}"
        )
    held = formats_of(folder)
    wanted = held[:1] if format == "auto" else [name for name in held if name == format]
    if not wanted:
        raise FileNotFoundError(_nothing(folder, format, held))
    if format == "auto" and len(held) > 1:
        listings = ", ".join(f"{name}: {READERS[name].LISTING}" for name in held)
        warn_once(
            f"{folder} holds photos in {len(held)} formats ({listings}) and is read as {held[0]}; "
            f"`format: {held[1]}` reads the other"
        )
    return READERS[wanted[0]].read(folder, images)


def _listings() -> str:
    return ", ".join(f"{reader.LISTING} ({name})" for name, reader in READERS.items())


def _nothing(folder: UPath, format: str, held: list[str]) -> str:
    inside = sorted(item.name for item in folder.iterdir())
    images = sum(name.lower().endswith(IMAGE_SUFFIXES) for name in inside)
    listed = ", ".join(inside[:8]) + (", ..." if len(inside) > 8 else "") or "nothing"
    if format != "auto":
        other = f"; it can be read as {', '.join(held)}" if held else ""
        return f"{folder} has no {READERS[format].LISTING}, which {format} needs{other}"
    return (
        f"{folder} has no transforms.json nor another listing of cameras; it holds {listed} "
        f"({images} images). Camera poses are needed: make them with COLMAP or with nerfstudio's "
        f"`ns-process-data`, or give the folder that holds one of {_listings()}"
    )

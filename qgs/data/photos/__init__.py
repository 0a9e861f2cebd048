"""Photos in folders: the formats that list their cameras, and which of them a folder holds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal, TypeAlias

from upath import UPath

from qgs.data.photos.blender import Blender
from qgs.data.photos.cameras import CamerasJson
from qgs.data.photos.checks import with_equal_times
from qgs.data.photos.colmap import Colmap
from qgs.data.photos.llff import Llff
from qgs.data.photos.nerfstudio import Nerfstudio
from qgs.data.photos.reader import IMAGE_SUFFIXES, Listing, PhotoReader
from qgs.data.scenes import warn_once
from qgs.wording import listed

READERS: tuple[type[PhotoReader], ...] = (Nerfstudio, Blender, Colmap, Llff, CamerasJson)
"""All formats. Where a folder holds several listings, the first of this order is read."""

_SMALLEST = (
    '{"fl_x": FOCAL_LENGTH_IN_PIXELS, "w": WIDTH, "h": HEIGHT, "frames": [{"file_path": '
    '"images/0.png", "transform_matrix": 4 x 4 camera-to-world, x right, y up, z back}, ...]}'
)

if TYPE_CHECKING:
    Format: TypeAlias = str
else:  # the choices of the option `format`
    Format = Literal["auto", *(reader.name for reader in READERS)]


def formats_of(folder: UPath) -> list[str]:
    """The formats whose listings `folder` holds, in the order in which they are preferred."""
    return [reader.name for reader in READERS if reader.recognises(folder)]


def read_listing(folder: UPath, format: Format = "auto", images: str | None = None) -> Listing:
    """The photos that `folder` lists in `format`, or in the first of `READERS` that it holds.

    images: another folder of photos, such as images_4. Raises FileNotFoundError for no folder or no
    listing, ValueError for a listing that cannot be read.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"photo folder {folder} (from {UPath.cwd()}) does not exist or is no folder: give the "
            f"folder that holds {_listings()}"
        )
    held = [reader for reader in READERS if reader.recognises(folder)]
    wanted = [reader for reader in held if format in ("auto", reader.name)]
    if not wanted:
        raise FileNotFoundError(_nothing(folder, format, held))
    if len(wanted) > 1:
        listings = ", ".join(f"{reader.name}: {reader.listing}" for reader in held)
        warn_once(
            f"{folder} holds photos in {len(held)} formats ({listings}) and is read as "
            f"{held[0].name}; `format: {held[1].name}` reads the other"
        )
    return with_equal_times(wanted[0].read(folder, images))


def _listings() -> str:
    return ", ".join(f"{reader.listing} ({reader.name})" for reader in READERS)


def _image_counts(folder: UPath, name: str = "", depth: int = 3) -> Iterator[str]:
    """How many images `folder` and the folders below it hold, in words; each is listed once."""
    try:
        items = sorted(folder.iterdir(), key=lambda item: item.name)
    except PermissionError:
        yield f"{name} may not be read"
        return
    items = [item for item in items if not item.name.startswith(".")]
    if count := sum(item.name.lower().endswith(IMAGE_SUFFIXES) for item in items):
        yield f"{count} in {name or 'it'}"
    for item in items if depth else ():
        if item.is_dir():
            yield from _image_counts(item, f"{name}{item.name}/", depth - 1)


def _nothing(folder: UPath, format: Format, held: list[type[PhotoReader]]) -> str:
    if format != "auto":
        listing = next(reader.listing for reader in READERS if reader.name == format)
        names = ", ".join(reader.name for reader in held)
        other = f"; it can be read as {names}" if held else ""
        return f"{folder} has no {listing}, which {format} needs{other}"
    inside = sorted(item.name for item in folder.iterdir())
    images = listed(_image_counts(folder))
    return (
        f"{folder} has no transforms.json nor another listing of cameras; it holds "
        f"{listed(inside) or 'nothing'} (images: {images or 'none'}). Camera poses are "
        "needed: make them with COLMAP or with nerfstudio's `ns-process-data`, or give the folder "
        f"that holds one of {_listings()}. The smallest transforms.json that would do: {_SMALLEST}"
    )

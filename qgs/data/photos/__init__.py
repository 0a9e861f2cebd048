"""Photos in folders: formats that list cameras, and which of them a folder holds."""

from __future__ import annotations

from collections.abc import Iterator

from upath import UPath

from qgs.data.photos.cameras import CamerasJson
from qgs.data.photos.checks import with_equal_times
from qgs.data.photos.colmap import Colmap
from qgs.data.photos.llff import Llff
from qgs.data.photos.nerfstudio import Blender, Nerfstudio
from qgs.data.photos.reader import IMAGE_SUFFIXES, Listing, PhotoReader
from qgs.data.scenes import warn_once
from qgs.extensions import ExtensionError, installed, load
from qgs.wording import listed

READERS: tuple[type[PhotoReader], ...] = (Nerfstudio, Blender, Colmap, Llff, CamerasJson)
"""The built-in formats. Where a folder holds several listings, the first of this order is read."""
GROUP = "qgs.photo_readers"
"""Entry point group of further readers: format name = module:subclass of `PhotoReader`."""

_SMALLEST = (
    '{"fl_x": FOCAL_LENGTH_IN_PIXELS, "w": WIDTH, "h": HEIGHT, "frames": [{"file_path": '
    '"images/0.png", "transform_matrix": 4 x 4 camera-to-world, x right, y up, z back}, ...]}'
)


def readers() -> dict[str, type[PhotoReader]]:
    """Format name to reader: READERS, then those of installed distributions.

    The latter come last, so that installing one changes no folder that could be read before. One
    that cannot be loaded is left out and logged.
    """
    found = {reader.name: reader for reader in READERS}
    for entry in installed(GROUP):
        try:
            found.setdefault(entry.name, load(entry, PhotoReader))
        except ExtensionError as error:
            warn_once(str(error))
    return found


def formats_of(folder: UPath) -> list[str]:
    """The formats whose listings `folder` holds, in the order of `readers`."""
    return [name for name, reader in readers().items() if reader.recognises(folder)]


def read_listing(folder: UPath, format: str = "auto", images: str | None = None) -> Listing:
    """The photos that `folder` lists in `format`, or in the first of `readers` that it holds.

    images: another folder of photos, such as images_4. Raises FileNotFoundError for no folder or no
    listing, ValueError for an unknown format and for a listing that cannot be read.
    """
    known = readers()
    listings = ", ".join(f"{reader.listing} ({name})" for name, reader in known.items())
    if format not in ("auto", *known):
        raise ValueError(f"there is no photo format {format!r}: use auto, {', '.join(known)}")
    if not folder.is_dir():
        raise FileNotFoundError(
            f"photo folder {folder} (from {UPath.cwd()}) does not exist or is no folder: give the "
            f"folder that holds {listings}"
        )
    held = formats_of(folder)
    wanted = [name for name in held if format in ("auto", name)]
    if not wanted and format != "auto":
        other = f"; it can be read as {', '.join(held)}" if held else ""
        needed = known[format].listing
        raise FileNotFoundError(f"{folder} has no {needed}, which {format} needs{other}")
    if not wanted:
        inside = listed(sorted(item.name for item in folder.iterdir()))
        raise FileNotFoundError(
            f"{folder} has no transforms.json nor another listing of cameras; it holds "
            f"{inside or 'nothing'} (images: {listed(_image_counts(folder)) or 'none'}). Camera "
            "poses are needed: make them with COLMAP or with nerfstudio's `ns-process-data`, or "
            f"give the folder that holds one of {listings}. The smallest transforms.json that "
            f"would do: {_SMALLEST}"
        )
    if len(wanted) > 1:
        warn_once(
            f"{folder} holds photos in {len(held)} formats ({', '.join(held)}) and is read as "
            f"{held[0]}; `format: {held[1]}` reads the other"
        )
    return with_equal_times(known[wanted[0]].read(folder, images))


def _image_counts(folder: UPath, name: str = "", depth: int = 3) -> Iterator[str]:
    """How many images `folder` and the folders in it hold."""
    items = sorted(folder.iterdir(), key=lambda item: item.name)
    items = [item for item in items if not item.name.startswith(".")]
    if count := sum(item.name.lower().endswith(IMAGE_SUFFIXES) for item in items):
        yield f"{count} in {name or 'it'}"
    for item in items if depth else ():
        if item.is_dir():
            yield from _image_counts(item, f"{name}{item.name}/", depth - 1)

"""Photos in folders: formats that list cameras, and which of them a folder holds."""

from __future__ import annotations

from upath import UPath

from qgs.data.photos.checks import with_equal_times
from qgs.data.photos.colmap import Colmap
from qgs.data.photos.nerfstudio import Nerfstudio
from qgs.data.photos.reader import Listing, PhotoReader
from qgs.extensions import ExtensionError, installed, load
from qgs.paths import is_local, listing
from qgs.wording import listed, warn_once

READERS: tuple[type[PhotoReader], ...] = (Nerfstudio, Colmap)
"""The built-in formats. Where a folder holds several listings, the first of this order is read."""
GROUP = "qgs.photo_readers"
"""Entry point group of further readers: format name = module:subclass of `PhotoReader`."""

_SMALLEST = (
    '{"fl_x": FOCAL_LENGTH_IN_PIXELS, "w": WIDTH, "h": HEIGHT, "frames": [{"file_path": '
    '"images/0.png", "transform_matrix": 4 x 4 camera-to-world, x right, y up, z back}, ...]}'
)


def readers() -> dict[str, type[PhotoReader]]:
    """Return readers by format name: READERS, then those of installed distributions.

    The latter come last, so that installing one changes no folder that could be read before. One
    that cannot be loaded is left out and logged.
    """
    found = {reader.name: reader for reader in READERS}
    for entry in installed(GROUP):
        # A broken distribution must not hinder folders of other formats.
        try:
            found.setdefault(entry.name, load(entry, PhotoReader))
        except ExtensionError as error:
            warn_once(str(error))
    return found


def formats_of(folder: UPath) -> list[str]:
    """Return the formats whose listings `folder` holds, in the order of `readers`."""
    return [name for name, reader in readers().items() if reader.recognises(folder)]


def with_cameras(path: UPath) -> UPath:
    """Return `path`, or the folder with cameras that a reader makes of photos without cameras."""
    if not is_local(path) or formats_of(path):
        return path
    # A folder of scenes may hold other pictures too.
    if any(formats_of(item) for item in listing(path) if item.is_dir()):
        return path
    made = (reader.posed(path) for reader in readers().values())
    return next(filter(None, made), path)


def read_listing(folder: UPath, format: str = "auto", images: str | None = None) -> Listing:
    """Read the photos that `folder` lists in `format`, or in the first of `readers` that it holds.

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
    if held and format not in ("auto", *held):
        needed = known[format].listing
        raise FileNotFoundError(
            f"{folder} has no {needed}, which {format} needs; it can be read as {', '.join(held)}"
        )
    if not held:
        inside = listed(sorted(item.name for item in folder.iterdir()))
        raise FileNotFoundError(
            f"{folder} lists no cameras; it holds {inside or 'nothing'}. Make some by `qgs poses`, "
            f"or give a folder that holds one of {listings}. A minimal transforms.json: {_SMALLEST}"
        )
    if format == "auto" and len(held) > 1:
        warn_once(
            f"{folder} holds photos in {len(held)} formats ({', '.join(held)}) and is read as "
            f"{held[0]}; in a recipe, data.format: {held[1]} reads the other"
        )
    return with_equal_times(known[held[0] if format == "auto" else format].read(folder, images))

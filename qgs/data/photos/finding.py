"""Files of a listing: where the listing says that they are, or in another folder or spelling."""

import os
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from typing import TypeAlias

from PIL import Image
from upath import UPath

from qgs.data.photos.reader import Listing, PhotoFrame, image_folder
from qgs.paths import listing
from qgs.wording import listed, name_shown, warn_once

_Index: TypeAlias = Mapping[object, list[UPath]]
"""Content of a folder, by each of the `_spellings` of its name."""


def located(found: Listing, folder: UPath, images: str | None, outside: bool) -> Listing:
    """Return `found` with its photos, masks and depth maps where they are in `folder`.

    A note counts files that are not where they are listed. Files that are not found stay as listed.

    images: the folder in `folder` that photos are read from. outside: files elsewhere are taken,
    too. Raises ValueError where two files may be meant, and for a file outside of `folder`.
    """
    photos = [frame.path for frame in found.frames if frame.name]
    maps = [file for frame in found.frames for file in (frame.mask, frame.depth) if file]
    where = found_files(folder, photos, maps, images, outside)
    for file in () if outside else (*photos, *maps):
        # A listing of a stranger must not name other files of this machine.
        if not is_inside(folder, where.get(file, file)):
            raise ValueError(
                f"{found.file} names {name_shown(str(file))}, which is outside of {folder}: move "
                "it into the folder, or train with data.outside=true"
            )
    frames = list[PhotoFrame]()
    for frame in found.frames:
        path = where.get(frame.path, frame.path)
        name = frame.name if path == frame.path else "/".join(inside(folder, path))
        mask = frame.mask and where.get(frame.mask, frame.mask)
        depth = frame.depth and where.get(frame.depth, frame.depth)
        frames.append(replace(frame, name=name, path=path, mask=mask, depth=depth))
    # Data sets are often shipped with reduced copies alone.
    moved = {
        file: real
        for file, real in where.items()
        if real.name != file.name or not (real == file or images or "images_" in real.parent.name)
    }
    for file in [*moved][:1]:
        warn_once(
            f"{len(moved)} of {len(where)} files are in another folder or spelling than "
            f"{found.file} lists: {name_shown(f'{moved[file]} for {file}')}"
        )
    return replace(found, frames=frames, present={*where.values()})


def found_files(
    folder: UPath,
    photos: Iterable[UPath],
    maps: Iterable[UPath] = (),
    images: str | None = None,
    outside: bool = False,
) -> dict[UPath, UPath]:
    """Return where listed photos and maps are, for those that are found.

    A file that is not where it is listed is looked for in `folder` and in its folder of images,
    without more and more of the folders that are listed before its name. images, outside: see
    `located`. Raises ValueError where two files may be meant.
    """
    indexed = cache(_index)
    photo_folder = image_folder(folder, images)
    # By hash: a listing may name thousands.
    photos = dict.fromkeys(photos)
    files = (*photos, *maps)
    where = dict[UPath, UPath]()
    for file in files:
        read_there = (outside or is_inside(folder, file)) and not (images and file in photos)
        if read_there and (0, file.name) in indexed(file.parent):
            where[file] = file
    taken = {*where}
    for file in files:
        if file in where:
            continue
        parts = inside(folder, file) if is_inside(folder, file) else file.parts[1:]
        # Of Windows, as COLMAP writes them there.
        parts = "/".join(parts).replace("\\", "/").split("/")
        places = [photo_folder] if images and file in photos else [folder, photo_folder]
        for first, place in product(range(len(parts)), places):
            real = _resolved(place, parts[first:], indexed)
            # A file that is found for one listed is not meant by another: a photo is no mask.
            if real and real not in taken:
                where[file] = real
                taken.add(real)
                break
    return where


def _resolved(
    place: UPath, parts: Sequence[str], indexed: Callable[[UPath], _Index]
) -> UPath | None:
    """Return what lies below `place` under a path of such parts. Raises as `located`."""
    for part in parts:
        index = indexed(place)
        held = next((index[way] for way in _spellings(part) if way in index), [])
        if len(held) > 1:
            raise ValueError(
                f"{name_shown(part)} may be any of {listed(held)}: correct its name in the "
                "listing, or move the others away"
            )
        if not held:
            return None
        place = held[0]
    return place


def _index(folder: UPath) -> _Index:
    """Return what is in `folder` by each of its `_spellings`."""
    index = defaultdict[object, list[UPath]](list)
    for item in sorted(listing(folder), key=str):
        for way in _spellings(item.name):
            index[way].append(item)
    return index


def _spellings(name: str) -> enumerate[str]:
    """Yield a name, then without letter case and form of Unicode, then without suffix, too."""
    key = unicodedata.normalize("NFC", name).casefold()
    stem, dot, suffix = key.rpartition(".")
    known = dot + suffix in (*Image.registered_extensions(), ".npy", ".heic")
    return enumerate((name, key, stem if known else key))


def inside(folder: UPath, path: UPath) -> Sequence[str]:
    """Return the parts of `path` relative to `folder`."""
    return os.path.relpath(path.path, folder.path or ".").split(os.sep)


def is_inside(folder: UPath, path: UPath) -> bool:
    """Return whether `path` is below `folder`, by its name: links are not followed."""
    return ".." not in inside(folder, path)

"""Search for the files that a listing names: as listed, or in another folder or spelling."""

import os
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product

from PIL import Image
from upath import UPath

from qgs.data.photos.reader import Listing, PhotoFrame, image_folder
from qgs.paths import listing
from qgs.wording import listed, name_shown, warn_once

_Index = Mapping[object, list[UPath]]
"""Files and subfolders of a folder; the keys are the `_spellings` of their names."""


def located(found: Listing, folder: UPath, images: str | None, outside: bool) -> Listing:
    """Return `found` with the paths at which its photos, masks and depth maps exist.

    A warning counts the files that exist only in another folder, or under another spelling of their
    names, than listed. Files that are not found keep their listed paths.

    images: subfolder of `folder` from which photos are read. outside: allow files outside of
        `folder`. Raises ValueError if two files fit a name, and for a file outside of `folder` that
        is not allowed.
    """
    photos = [frame.path for frame in found.frames if frame.name]
    maps = [file for frame in found.frames for file in (frame.mask, frame.depth) if file]
    where = found_files(folder, photos, maps, images, outside)
    for file in () if outside else (*photos, *maps):
        # A listing of a stranger must not name other files of this machine.
        if not is_inside(folder, where.get(file, file)) and file.is_file():
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
        if real.name != file.name
        or not (real == file or images or real.parent.name.startswith("images_"))
    }
    for file in [*moved][:1]:
        warn_once(
            f"{len(moved)} of {len(where)} files are in another folder or have another name than "
            f"{found.file} lists, for example {name_shown(f'{moved[file]} instead of {file}')}"
        )
    # A frame that names no file has the folder as its path: its problem is told, not its absence.
    return replace(found, frames=frames, present={folder, *where.values()})


def found_files(
    folder: UPath,
    photos: Iterable[UPath],
    maps: Iterable[UPath] = (),
    images: str | None = None,
    outside: bool = False,
) -> dict[UPath, UPath]:
    """Return the existing path of each listed photo or map; leave out files that are not found.

    A file that is not where it is listed is searched for in `folder` and in its folder of images:
    under its whole listed path, then without the first folder of this path, then without the first
    two, and so on.

    images: subfolder of `folder` from which photos are read. outside: allow files outside of
        `folder`. Raises ValueError if two files fit a name, or if one file fits the names of two
        photos.
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
    taken = {file: file for file in where}
    for file in files:
        if file in where:
            continue
        parts = inside(folder, file) if is_inside(folder, file) else file.parts[1:]
        # Of Windows, as COLMAP writes them there.
        parts = "/".join(parts).replace("\\", "/").split("/")
        places = [photo_folder] if images and file in photos else [folder, photo_folder]
        for first, place in product(range(len(parts)), places):
            real = _resolved(place, parts[first:], indexed)
            if real is None:
                continue
            other = taken.setdefault(real, file)
            if other == file:
                where[file] = real
                break
            # A file that exists as listed is meant by no other name; a photo is no mask.
            if other != real and {file, other} <= photos.keys():
                raise ValueError(
                    f"{real} fits two names, {name_shown(str(other))} and {name_shown(str(file))}: "
                    "correct these names in the file of poses"
                )
    return where


def _resolved(
    place: UPath, parts: Sequence[str], indexed: Callable[[UPath], _Index]
) -> UPath | None:
    """Return the file below the folder `place` that matches the path `parts`; None if none does.

    Names match if one of their `_spellings` is equal. Raises ValueError if two files match.
    """
    for part in parts:
        index = indexed(place)
        held = next((index[way] for way in _spellings(part) if way in index), [])
        if len(held) > 1:
            raise ValueError(
                f"{name_shown(part)} may be any of {listed(held)}: correct the name in the "
                "listing, or move all but one of these files away"
            )
        if not held:
            return None
        place = held[0]
    return place


def _index(folder: UPath) -> _Index:
    """Return the files and subfolders of `folder`; the keys are the `_spellings` of their names."""
    index = defaultdict[object, list[UPath]](list)
    for item in sorted(listing(folder), key=str):
        for way in _spellings(item.name):
            index[way].append(item)
    return index


def _spellings(name: str) -> enumerate[str]:
    """Yield (0, name), (1, name in lower case and NFC), (2, the latter without image suffix)."""
    key = unicodedata.normalize("NFC", name).casefold()
    stem, dot, suffix = key.rpartition(".")
    known = dot + suffix in (*Image.registered_extensions(), ".heic", ".heif")
    return enumerate((name, key, stem if known else key))


def inside(folder: UPath, path: UPath) -> Sequence[str]:
    """Return the parts of the path from `folder` to `path`.

    If `path` is outside of `folder`, the first part is "..".
    """
    return os.path.relpath(path.path, folder.path or ".").split(os.sep)


def is_inside(folder: UPath, path: UPath) -> bool:
    """Return whether `path` is below `folder`, judged by the path alone: links are not followed."""
    return ".." not in inside(folder, path)

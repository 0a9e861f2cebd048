"""Where the files of a listing are: as it says, or in another folder or spelling of its own."""

import os
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import PurePosixPath

from PIL import Image
from upath import UPath

from qgs.data.photos.reader import Listing, existing, image_folder
from qgs.paths import listing
from qgs.wording import listed, name_shown, warn_once


def located(found: Listing, folder: UPath, images: str | None, outside: bool) -> Listing:
    """Return `found` with its photos, masks and depth maps where they are in `folder`.

    images: the folder in it that photos are read from. outside: files elsewhere are taken, too.
    One note tells what is listed otherwise; what is not there stays as listed. Raises ValueError
    where two files may be meant, and for a file outside of `folder`.
    """
    frames = [frame for frame in found.frames if frame.name]
    photos = found_files(folder, (frame.path for frame in frames), images, outside)
    maps = [file for frame in frames for file in (frame.mask, frame.depth) if file]
    # A photo is no mask of another one.
    others = found_files(folder, {*maps} - {*photos}, None, outside)
    where = photos | {file: real for file, real in others.items() if real not in photos.values()}
    if not outside:
        for file in filter(None, (*(frame.path for frame in frames), *maps)):
            if not is_inside(folder, where.get(file, file)):
                raise ValueError(
                    f"{found.file} names {name_shown(str(file))}, which is outside of {folder}: "
                    "move it into the folder, or train with data.outside=true"
                )
    moved = [file for file in where if _told(file, where[file], images)]
    if moved:
        ways = Counter(_told(file, where[file], images) for file in moved)
        first = f"{name_shown(str(moved[0]))} as {where[moved[0]]}"
        warn_once(
            f"{len(moved)} of {len(where)} files that {found.file} lists are found elsewhere: "
            f"{listed(f'{count} {way}' for way, count in ways.items())}; {first}"
        )
    return replace(
        found,
        frames=[
            replace(
                frame,
                path=where.get(frame.path, frame.path),
                name="/".join(inside(folder, where[frame.path]))
                if frame.path in where and where[frame.path] != frame.path
                else frame.name,
                mask=frame.mask and where.get(frame.mask, frame.mask),
                depth=frame.depth and where.get(frame.depth, frame.depth),
            )
            for frame in found.frames
        ],
    )


def _told(file: UPath, real: UPath, images: str | None) -> str:
    """Return how the listed `file` was found; "" where nobody needs to be told."""
    if real.name != file.name:
        return "in other letters" if _key(real.name) == _key(file.name) else "with another suffix"
    # Reduced copies alone are how data sets are shipped.
    silent = real == file or images or real.parent.name.startswith("images_")
    return "" if silent else "in another folder"


def found_files(
    folder: UPath, files: Iterable[UPath], images: str | None = None, outside: bool = False
) -> Mapping[UPath, UPath]:
    """Return where listed `files` are, of those that are found.

    A file is looked for in `folder`, and in `images` there, without more and more of the folders
    that are listed before its name. images, outside: as of `located`. Raises as that.
    """
    files = [*dict.fromkeys(files)]
    bases = [folder / images] if images else [folder, image_folder(folder, None)]
    allowed = (file for file in files if outside or is_inside(folder, file))
    found = {} if images else {file: file for file in existing(allowed)}
    # A file that is listed itself is not meant by another name, too.
    meant = dict(found)
    indexed = cache(_index)
    for file in files:
        parts = inside(folder, file)
        parts = file.parts[1:] if not is_inside(folder, file) else parts
        for first in range(0 if file in found else len(parts)):
            for base in bases:
                real = _resolved(base, parts[first:], indexed)
                if real and file not in found and meant.setdefault(real, file) == file:
                    found[file] = real
    return found


def _resolved(
    place: UPath, parts: Sequence[str], indexed: Callable[[UPath], Mapping[object, list[UPath]]]
) -> UPath | None:
    """Return what lies below `place` under a path of such parts. Raises as `located`."""
    for part in parts:
        ways = (indexed(place).get(way) for way in _spellings(part))
        held = next(filter(None, ways), None)
        if held is None:
            return None
        if len(held) > 1:
            raise ValueError(
                f"{name_shown(part)} may be any of {listed(held)}: correct its name in the "
                "listing, or move the others away"
            )
        place = held[0]
    return place


def _index(folder: UPath) -> Mapping[object, list[UPath]]:
    """Return what is in `folder` by each of its `_spellings`."""
    index = defaultdict[object, list[UPath]](list)
    for item in sorted(listing(folder), key=str):
        for way in _spellings(item.name):
            index[way].append(item)
    return index


def _spellings(name: str) -> Iterable[tuple[int, str]]:
    """Yield a name, then without letter case and form of Unicode, then without suffix, too."""
    known = PurePosixPath(name).suffix.lower() in (*Image.registered_extensions(), ".npy")
    key = _key(name)
    return enumerate((name, key, key.rpartition(".")[0] if known else key))


def _key(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def inside(folder: UPath, path: UPath) -> Sequence[str]:
    """Return the parts of `path` relative to `folder`; the first is .. where it is not in it."""
    return os.path.relpath(path.path, folder.path or ".").split(os.sep)


def is_inside(folder: UPath, path: UPath) -> bool:
    """Return whether `path` is below `folder`, by its name: links are not followed."""
    return ".." not in inside(folder, path)

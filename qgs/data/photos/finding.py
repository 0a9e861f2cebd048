"""Files of a listing: where it says that they are, or in another folder or spelling."""

import os
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import PurePosixPath

from PIL import Image
from upath import UPath

from qgs.data.photos.reader import Listing, PhotoFrame, image_folder
from qgs.paths import listing
from qgs.wording import listed, name_shown, warn_once


def located(found: Listing, folder: UPath, images: str | None, outside: bool) -> Listing:
    """Return `found` with its photos, masks and depth maps where they are in `folder`.

    images: the folder in it that photos are read from. outside: files elsewhere are taken, too.
    One note tells what is listed otherwise; what is not there stays as listed. Raises ValueError
    where two files may be meant, and for a file outside of `folder`.
    """
    frames = [frame for frame in found.frames if frame.name]
    maps = [file for frame in frames for file in (frame.mask, frame.depth) if file]
    photos = [frame.path for frame in frames]
    taken = {*photos}
    where = found_files(
        folder, photos, dict.fromkeys(file for file in maps if file not in taken), images, outside
    )

    def there(file: UPath) -> UPath:
        return where.get(file, file)

    ways = Counter[str]()
    for file, real in where.items():
        if real.name != file.name:
            ways["with other letters or suffix"] += 1
        # Reduced copies alone are how data sets are shipped.
        elif real != file and not images and not real.parent.name.startswith("images_"):
            ways["in another folder"] += 1
    if ways:
        first = next(f"{where[file]} for {file}" for file in where if where[file] != file)
        warn_once(
            f"{ways.total()} of {len(where)} files are not found as {found.file} lists them, but "
            f"{listed(f'{count} {way}' for way, count in ways.items())}: {name_shown(first)}"
        )
    for file in () if outside else (*photos, *maps):
        # A listing of a stranger must not name other files of this machine.
        if not is_inside(folder, there(file)):
            raise ValueError(
                f"{found.file} names {name_shown(str(file))}, which is outside of {folder}: move "
                "it into the folder, or train with data.outside=true"
            )

    def moved(frame: PhotoFrame) -> PhotoFrame:
        path, mask, depth = (file and there(file) for file in (frame.path, frame.mask, frame.depth))
        assert path is not None
        name = frame.name if path == frame.path else "/".join(inside(folder, path))
        return replace(frame, name=name, path=path, mask=mask, depth=depth)

    return replace(found, frames=[*map(moved, found.frames)], present={*where.values()})


def found_files(
    folder: UPath,
    photos: Iterable[UPath],
    maps: Collection[UPath] = (),
    images: str | None = None,
    outside: bool = False,
) -> dict[UPath, UPath]:
    """Return where listed photos and maps are, of those that are found.

    A file is looked for in `folder`, and in `images` there, without more and more of the folders
    that are listed before its name. images, outside: as of `located`. Raises as that.
    """
    indexed = cache(_index)
    bases = [folder, image_folder(folder, images)]
    found: dict[UPath, UPath] = {}
    missing: list[UPath] = []
    for file in dict.fromkeys((*photos, *maps)):
        reached = (outside or is_inside(folder, file)) and (not images or file in maps)
        if reached and (0, file.name) in indexed(file.parent):
            found[file] = file
        else:
            missing.append(file)
    # A file that is found for one listed is not meant by another; a photo is no mask.
    meant = dict(found)
    for file in missing:
        parts = inside(folder, file) if is_inside(folder, file) else file.parts[1:]
        # Of Windows, as COLMAP writes them there.
        parts = PurePosixPath("/".join(parts).replace("\\", "/")).parts
        places = bases[1:] if images and file not in maps else bases
        for first, base in product(range(len(parts)), places):
            real = _resolved(base, parts[first:], indexed)
            if real and meant.setdefault(real, file) == file:
                found[file] = real
                break
    return found


def _resolved(
    place: UPath, parts: Sequence[str], indexed: Callable[[UPath], Mapping[object, list[UPath]]]
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


def _index(folder: UPath) -> Mapping[object, list[UPath]]:
    """Return what is in `folder` by each of its `_spellings`."""
    index = defaultdict[object, list[UPath]](list)
    for item in sorted(listing(folder), key=str):
        for way in _spellings(item.name):
            index[way].append(item)
    return index


def _spellings(name: str) -> Iterable[tuple[int, str]]:
    """Yield a name, then without letter case and form of Unicode, then without suffix, too."""
    key = unicodedata.normalize("NFC", name).casefold()
    stem, dot, suffix = key.rpartition(".")
    known = dot + suffix in (*Image.registered_extensions(), ".npy", ".heic", ".heif", ".dng")
    return enumerate((name, key, stem if known else key))


def inside(folder: UPath, path: UPath) -> Sequence[str]:
    """Return the parts of `path` relative to `folder`."""
    return os.path.relpath(path.path, folder.path or ".").split(os.sep)


def is_inside(folder: UPath, path: UPath) -> bool:
    """Return whether `path` is below `folder`, by its name: links are not followed."""
    return ".." not in inside(folder, path)

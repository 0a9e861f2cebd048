"""Where the files of a listing are: as it says, or in another folder or spelling of its own."""

import os
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import chain, product
from pathlib import PurePosixPath

from PIL import Image
from upath import UPath

from qgs.data.photos.reader import Listing, PhotoFrame, existing, image_folder
from qgs.paths import listing
from qgs.wording import listed, name_shown, warn_once


def located(found: Listing, folder: UPath, images: str | None, outside: bool) -> Listing:
    """Return `found` with its photos, masks and depth maps where they are in `folder`.

    images: the folder in it that photos are read from. outside: files elsewhere are taken, too.
    One note tells what is listed otherwise; what is not there stays as listed. Raises ValueError
    where two files may be meant, and for a file outside of `folder`.
    """
    frames = [frame for frame in found.frames if frame.name]
    maps = [*filter(None, chain.from_iterable((f.mask, f.depth) for f in frames))]
    where = found_files(folder, (frame.path for frame in frames), images, outside)
    # A photo is no mask of another one.
    photos = {*where.values()}
    others = found_files(folder, (file for file in maps if file not in where), None, outside)
    where |= {file: real for file, real in others.items() if real not in photos}
    ways = Counter[str]()
    for file, real in where.items():
        # Reduced copies alone are how data sets are shipped.
        silent = real == file or images or real.parent.name.startswith("images_")
        if real.name != file.name:
            alike = _key(real.name) == _key(file.name)
            ways["in other letters" if alike else "with another suffix"] += 1
        elif not silent:
            ways["in another folder"] += 1
    if ways:
        file, real = next(pair for pair in where.items() if pair[0] != pair[1])
        warn_once(
            f"{ways.total()} of {len(where)} files are not found as {found.file} lists them, but "
            f"{listed(f'{count} {way}' for way, count in ways.items())}: {real} for "
            f"{name_shown(str(file))}"
        )

    def put(frame: PhotoFrame) -> PhotoFrame:
        path = where.get(frame.path, frame.path)
        mask, depth = (file and where.get(file, file) for file in (frame.mask, frame.depth))
        name = frame.name if path == frame.path else "/".join(inside(folder, path))
        return replace(frame, name=name, path=path, mask=mask, depth=depth)

    frames = [put(frame) if frame.name else frame for frame in found.frames]
    for file in () if outside else (where.get(f, f) for f in (*maps, *(f.path for f in frames))):
        # A listing of a stranger must not name other files of this machine.
        if not is_inside(folder, file):
            raise ValueError(
                f"{found.file} names {name_shown(str(file))}, which is outside of {folder}: move "
                "it into the folder, or train with data.outside=true"
            )
    return replace(found, frames=frames)


def found_files(
    folder: UPath, files: Iterable[UPath], images: str | None = None, outside: bool = False
) -> dict[UPath, UPath]:
    """Return where listed `files` are, of those that are found.

    A file is looked for in `folder`, and in `images` there, without more and more of the folders
    that are listed before its name. images, outside: as of `located`. Raises as that.
    """
    files = {file: is_inside(folder, file) for file in files}
    bases = [*([] if images else [folder]), image_folder(folder, images)]
    allowed = (file for file, within in files.items() if outside or within)
    found = {} if images else {file: file for file in existing(allowed)}
    # A file that is listed itself is not meant by another name, too.
    meant = dict(found)
    indexed = cache(_index)
    for file in [file for file in files if file not in found]:
        parts = inside(folder, file) if files[file] else file.parts[1:]
        for first, base in product(range(len(parts)), bases):
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

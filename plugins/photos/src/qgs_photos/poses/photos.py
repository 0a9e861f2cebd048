"""Prepare photos for COLMAP: turn them upright, convert to 8-bit RGB, reduce large ones."""

import json
import os
import re
import shutil
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from PIL import Image, ImageOps
from upath import UPath

from qgs.data.images import eight_bits, opened_image, orientation
from qgs.wording import counted, listed
from qgs_photos.image_files import image_files

LEAST = 2
# Pixels of a side.
SMALLEST = 64
_FOREIGN = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".jxl")
# Kinds that browsers, viewers and COLMAP read; others are written as PNG.
_PLAIN = ("JPEG", "MPO", "PNG")
_ORIENTATION, _SUB, _MAKE, _MODEL = 0x0112, 0x8769, 0x010F, 0x0110
# Focal length, its equivalent of 35 mm film, lens.
_LENS = (0x920A, 0xA405, 0xA434)


Show = Callable[[str, int, int], None]
"""Function that shows progress: name of the stage, number of steps done, number of all steps."""


class PosesError(ValueError):
    """Error for photos or a video whose poses cannot be computed; its message says what to do."""


@dataclass(frozen=True)
class Photo:
    """A prepared photo.

    name: file name. size: (H, W) of the upright original in pixels. camera: text from EXIF that
    differs between cameras, lenses and focal lengths; empty without EXIF.
    """

    name: str
    size: tuple[int, int]
    camera: str


def photo_files(folder: Path) -> list[Path]:
    """Return the photos in `folder`; if it has none, those in images/, or in all subfolders.

    Photos are sorted by the numbers in their names, so that 2 precedes 10. Raises PosesError for
    fewer than LEAST photos.
    """
    root = UPath(folder)
    own = image_files(root) or image_files(root / "images")
    inside = sorted(item for item in root.iterdir() if item.is_dir() and item.name[0] != ".")
    photos = own or chain.from_iterable(map(image_files, inside))
    files = [Path(str(file)) for file in photos if file.is_file()]
    found = Path(str(own[0].parent)) if own else folder
    if len(files) >= LEAST:
        return sorted(files, key=lambda file: _by_number(str(file)))
    text = f"{found} holds {counted(len(files), 'photo')}, but poses need at least {LEAST}"
    if foreign := left_out_formats(found):
        raise PosesError(f"{text}; {listed(foreign, 3)} cannot be read: convert them to JPEG")
    raise PosesError(f"{text}: take more photos, from different positions")


def names_of(files: Sequence[Path]) -> list[str]:
    """Return the names of `files`, relative to the deepest folder that holds all of them."""
    top = os.path.commonpath([file.parent for file in files])
    return [file.relative_to(top).as_posix() for file in files]


def _by_number(name: str) -> tuple[str, str]:
    """Return a key for sorting names by the numbers in them: "2" before "10"."""
    return re.sub(r"\d+", lambda found: found[0].zfill(20), name), name


def left_out_formats(folder: Path) -> list[str]:
    """Return the names of photos in `folder` whose formats cannot be read, such as raw photos."""
    names = (file.name for file in folder.iterdir())
    return sorted(name for name in names if name.lower().endswith(_FOREIGN))


def prepare(
    files: Sequence[Path],
    kept: Path,
    working: Path,
    side: int,
    progress: Show = lambda stage, done, total: None,
) -> tuple[list[Photo], dict[str, str]]:
    """Write upright photos into `kept`, and copies of at most `side` pixels into `working`.

    A file that needs no change is linked, or copied if links are impossible. If the order of
    `files` is not the alphabetical order of names, which COLMAP uses, names get a number in front.

    Returns the prepared photos in the order of `files`, and by name the reason why a photo cannot
    be read. progress: called with the stage, the number of photos done, and the number of all.
    """
    ready = list[Photo]()
    faulty = dict[str, str]()
    names = names_of(files)
    # IMG 10 comes before IMG 2 as text
    if names != sorted(names):
        digits = len(str(len(names)))
        names = [f"{n:0{digits}}_{name.replace('/', '_')}" for n, name in enumerate(names)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs = [
            pool.submit(_prepared, *pair, kept, working, side)
            for pair in zip(files, names, strict=True)
        ]
        for name, job in zip(names, jobs, strict=True):
            try:
                ready.append(job.result())
            except (OSError, ValueError) as error:
                # a number of the system's: it is the disk that is at fault, not the photo
                if isinstance(error, OSError) and error.errno is not None:
                    raise
                faulty[name] = str(error)
            progress("photos", len(ready) + len(faulty), len(files))
    return ready, faulty


def _prepared(file: Path, name: str, kept: Path, working: Path, side: int) -> Photo:
    with file.open("rb") as opened, opened_image(opened) as image:
        if min(image.size) < SMALLEST:
            raise ValueError(
                f"{image.width} x {image.height} pixels are too few: take larger photos"
            )
        image.load()
        turned = orientation(image) != 1
        stays = image.format in _PLAIN
        plain = stays and image.mode in ("RGB", "L")
        upright = ImageOps.exif_transpose(image) if turned else image
        # last, because it takes the orientation out
        exif, camera = _exif(image)
    rgb = eight_bits(upright).convert("RGB")
    name = name if stays else f"{name}.png"
    for folder in (kept, working):
        (folder / name).parent.mkdir(exist_ok=True)
    if plain and not turned:
        _link(file, kept / name)
    else:
        _save(rgb, kept / name, exif)
    scale = min(side / max(rgb.size), 1.0)
    if scale < 1 or not plain:
        width, height = (max(round(extent * scale), 3) for extent in rgb.size)
        scaled = rgb.resize((width, height), Image.Resampling.LANCZOS, reducing_gap=2)
        _save(scaled, working / name, exif)
    else:
        _link(kept / name, working / name)
    return Photo(name, (rgb.height, rgb.width), camera)


def _exif(image: Image.Image) -> tuple[bytes, str]:
    """Return EXIF data without the orientation, and a text that identifies camera and focal length.

    Both are empty if EXIF is damaged.
    """
    try:
        exif = image.getexif()
        lens = exif.get_ifd(_SUB)
        # another focal length of one phone is another camera
        values = [exif.get(_MAKE), exif.get(_MODEL), *(lens.get(tag) for tag in _LENS)]
        exif.pop(_ORIENTATION, None)
        return exif.tobytes(), json.dumps([str(value).strip("\0 ") for value in values if value])
    except Exception:
        # Pillow raises anything of it
        return b"", ""


def _save(image: Image.Image, path: Path, exif: bytes) -> None:
    kind = "PNG" if path.suffix.lower() == ".png" else "JPEG"
    # PNG takes neither quality nor subsampling
    image.save(path, kind, exif=exif, quality=95, subsampling=0)


def _link(file: Path, path: Path) -> None:
    try:
        os.link(file.resolve(), path)
    except OSError:
        # another file system, or one without links
        shutil.copyfile(file, path)


def camera_groups(photos: Sequence[Photo]) -> list[list[str]]:
    """Return names of photos in groups that share a camera: same size, lens and focal length."""
    groups = defaultdict[object, list[str]](list)
    for photo in photos:
        groups[photo.size, photo.camera].append(photo.name)
    return list(groups.values())

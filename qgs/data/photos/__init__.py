"""Photos in folders: formats of camera listings, and reading the listing of a folder."""

from upath import UPath

from qgs.data.photos.finding import located
from qgs.data.photos.nerfstudio import Nerfstudio
from qgs.data.photos.reader import (
    Listing,
    PhotoFrame,
    PhotoReader,
    installed_readers,
    mended,
    sound_frames,
)
from qgs.paths import is_local, listing
from qgs.wording import listed, warn_once

_SMALLEST = (
    '{"fl_x": FOCAL_LENGTH_IN_PIXELS, "w": WIDTH, "h": HEIGHT, "frames": [{"file_path": '
    '"images/0.png", "transform_matrix": 4 x 4 camera-to-world, x right, y up, z back}, ...]}'
)


def readers() -> dict[str, type[PhotoReader]]:
    """Return all photo readers by format name: `Nerfstudio`, then those of plug-ins.

    If a folder has listings in several formats, the first of these formats is read.
    """
    own = {"nerfstudio": Nerfstudio}
    return own | installed_readers() | own


def formats_of(folder: UPath) -> list[str]:
    """Return names of the formats in which `folder` lists cameras, in the order of `readers`."""
    return [name for name, reader in readers().items() if reader.recognises(folder)]


def with_cameras(path: UPath) -> UPath:
    """Return a folder with photos and cameras for `path`, if a reader can make one; else `path`.

    A folder that lists cameras, or has subfolders that do, is returned unchanged.
    """
    if not is_local(path) or formats_of(path):
        return path
    # A folder of scenes may hold other pictures too.
    if any(formats_of(item) for item in listing(path) if item.is_dir()):
        return path
    made = (reader.posed(path) for reader in readers().values())
    return next(filter(None, made), path)


def read_listing(
    folder: UPath, format: str = "auto", images: str | None = None, outside: bool = False
) -> Listing:
    """Read the photos and cameras that `folder` lists.

    Files that are not where they are listed are searched for, see `located`.

    format: name of a format; "auto" takes the first of `readers` that fits. images: folder with
        scaled copies of the photos to read, such as images_4. outside: allow files outside of
        `folder`. Raises FileNotFoundError for a missing folder or listing, and ValueError for an
        unreadable listing and for files outside of `folder` that are not allowed.
    """
    known = readers()
    listings = ", ".join(f"{reader.listing} ({name})" for name, reader in known.items())
    if not folder.is_dir():
        raise FileNotFoundError(
            f"photo folder {folder} (from {UPath.cwd()}) does not exist or is not a folder: give "
            f"a folder with one of these: {listings}"
        )
    held = formats_of(folder)
    if held and format not in ("auto", *held):
        needed = known[format].listing
        raise FileNotFoundError(
            f"{folder} has no {needed}, which {format} needs; data.format can be {', '.join(held)}"
        )
    if not held:
        inside = listed(sorted(item.name for item in folder.iterdir()))
        more = "" if "colmap" in known else " (query-gaussians-photos reads more)"
        raise FileNotFoundError(
            f"{folder} lists no cameras; it holds {inside or 'nothing'}. Run `qgs poses`, "
            f"or give a folder with one of {listings}{more}. A minimal transforms.json: {_SMALLEST}"
        )
    if format == "auto" and len(held) > 1:
        warn_once(
            f"{folder} holds photos in {len(held)} formats ({', '.join(held)}) and is read as "
            f"{held[0]}; set data.format in a recipe to read another format"
        )
    found = known[held[0] if format == "auto" else format].read(folder, images)
    found = mended(located(found, found.folder or folder, images, outside))
    still = [frame.name for frame in found.frames if frame.time is None and not frame.problems]
    if still and len({frame.time is None for frame in found.frames}) > 1:
        raise ValueError(
            f"{found.file} gives 'time' only for some frames, not for {listed(still)}: write a "
            "time for all frames, or for no frame if nothing moves"
        )
    return found


def present_frames(
    folder: UPath, format: str = "auto", images: str | None = None, outside: bool = False
) -> tuple[list[PhotoFrame], list[str]]:
    """Return the frames of a folder's listing whose images exist, and paths of missing images.

    Frames that belong to no split of the listing are left out. Warnings count all that is left out.

    format: name of a format, or "auto". images: folder with scaled copies of the photos to read.
        outside: allow files outside of `folder`. Raises FileNotFoundError if fewer than two images
        exist or a mask is missing, and ValueError for impossible poses and intrinsics.
    """
    found = read_listing(folder, format, images, outside)
    frames = [frame for frame in found.frames if frame.split != "unused"]
    count = len(frames)
    if count < len(found.frames):
        warn_once(
            f"{len(found.frames) - count} of {len(found.frames)} frames of {found.file} are "
            "in none of its splits and are left out"
        )
    present = [frame for frame in frames if frame.path in found.present]
    missing = [str(frame.path) for frame in frames if frame.path not in found.present]
    # Before the count: a wrong listing explains missing images.
    sound = sound_frames(found.file, present if len(present) > 1 else frames)
    if len(present) < 2:
        raise FileNotFoundError(
            f"{found.file} names {count} images, but {len(present)} exist and 2 are needed: add "
            f"{listed(missing, 3) or 'photos'}, or set the option `images` to their folder"
        )
    if missing:
        warn_once(f"{len(missing)} of {count} images of {folder} are missing: {listed(missing, 3)}")
    masks = [frame.mask for frame in sound if frame.mask is not None]
    absent = sorted({str(mask) for mask in masks if mask not in found.present})
    if absent:
        raise FileNotFoundError(
            f"{found.file} names {len(masks)} masks, but {len(absent)} do not exist: "
            f"{listed(absent, 3)}. Add them, or remove their 'mask_path'"
        )
    return sound, missing

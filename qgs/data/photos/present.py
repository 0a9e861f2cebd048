"""The frames of a listing whose photos are there."""

from upath import UPath

from qgs.data.photos import read_listing
from qgs.data.photos.checks import refuse_fatal_problems, refuse_outside
from qgs.data.photos.reader import PhotoFrame, existing
from qgs.wording import listed, warn_once


def present_frames(
    folder: UPath, format: str = "auto", images: str | None = None, outside: bool = False
) -> tuple[list[PhotoFrame], list[str]]:
    """Return the frames of a listing's splits whose images exist, and the paths of the others.

    What is left out is logged. Raises FileNotFoundError when fewer than two images or a mask do not
    exist, ValueError for poses and intrinsics that cannot be right.
    """
    listing = read_listing(folder, format, images)
    # A listing of a stranger must not name other files of this machine.
    if not outside:
        refuse_outside(folder, listing)
    frames = [frame for frame in listing.frames if frame.split != "unused"]
    count = len(frames)
    if count < len(listing.frames):
        warn_once(
            f"{len(listing.frames) - count} of {len(listing.frames)} frames of {listing.file} are "
            "in none of its splits and are left out"
        )
    there = existing(frame.path for frame in frames)
    present = [frame for frame in frames if frame.path in there]
    missing = [str(frame.path) for frame in frames if frame.path not in there]
    # Before the count: a wrong listing explains missing images.
    refuse_fatal_problems(listing.file, present if len(present) > 1 else frames)
    if len(present) < 2:
        raise FileNotFoundError(
            f"{listing.file} names {count} images, but {len(present)} exist and 2 are needed: add "
            f"{listed(missing, 3) or 'photos'}"
        )
    if missing:
        warn_once(f"{len(missing)} of {count} images of {folder} are missing: {listed(missing, 3)}")
    masks = [frame.mask for frame in present if frame.mask is not None]
    absent = sorted({*map(str, masks)} - {*map(str, existing(masks))})
    if absent:
        raise FileNotFoundError(
            f"{listing.file} names {len(masks)} masks, but {len(absent)} do not exist: "
            f"{listed(absent, 3)}. Add them, or remove their 'mask_path'"
        )
    return present, missing

"""Compute missing camera poses by COLMAP when a command opens a video, or photos without poses."""

import json
from contextlib import suppress
from pathlib import Path

from filelock import FileLock
from rich.console import Console
from upath import UPath

from qgs.terminal import print_lines
from qgs.wording import listed
from qgs_photos.datasets.colmap import Colmap, models
from qgs_photos.image_files import image_files
from qgs_photos.poses.making import RECORD, Options, fingerprint, make_poses
from qgs_photos.poses.photos import PosesError, photo_files

SECONDS_OF_PHOTO = 1.8
"""Estimated CPU time, in seconds, to compute the pose of one large photo."""
VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")


class ColmapOrPhotos(Colmap):
    """Reader of COLMAP's models that runs COLMAP for videos and for photos without poses."""

    @classmethod
    def posed(cls, path: UPath) -> UPath | None:
        """Return the folder NAME_poses with the poses of `path`, a folder of photos or a video.

        The folder lies beside `path`. COLMAP computes missing poses. Returns None if `path` is
        neither a video nor a folder with photos. Raises FileNotFoundError if a folder such as
        sparse/0 in `path` has only a part of a COLMAP model.
        """
        for place, _, missing in models(path):
            # beside photos the other file may be of another program
            if place != path:
                raise FileNotFoundError(
                    f"{place} has a COLMAP model without {listed(missing)}: copy this file too, or "
                    f"move {place} away to compute poses anew"
                )
        # anything else is left to the readers of listings, whose errors say what it lacks
        is_video = path.suffix.lower() in VIDEOS and path.is_file()
        if is_video or any(map(image_files, (path, path / "images"))):
            return UPath(posed_folder(Path(str(path))))
        return None


def posed_folder(source: Path) -> Path:
    """Return the folder NAME_poses with the camera poses of `source`, photos or a video.

    The folder lies beside `source`. Missing poses are computed. Raises PosesError if the folder
    holds poses of other photos, OSError if the folder cannot be written, and the errors of
    `make_poses`.
    """
    out = beside(source)
    lock = out.with_name(f".{out.name}.lock")
    console = Console(stderr=True)
    try:
        # of several processes that open the same photos the first makes poses, the others wait
        if not is_made(source, out):
            with FileLock(lock):
                if not is_made(source, out):
                    text = "has no camera poses: computing them once, into"
                    print_lines(console, [f"{source} {text} {out}{_duration(source)}"])
                    print_lines(console, make_poses(source, out, Options(), console).summary)
                # Windows keeps it
                with suppress(OSError):
                    lock.unlink()
    except PermissionError as error:
        raise OSError(
            f"{out} cannot be written ({error.strerror}): run `qgs poses {source} --out FOLDER`, "
            "and use FOLDER in place of the photos"
        ) from error
    return out


def _duration(source: Path) -> str:
    """Return text with the estimated time to compute poses of photos; "" for a video."""
    if source.is_file():
        return ""
    seconds = SECONDS_OF_PHOTO * len(photo_files(source)) / Options.threads
    return f", in about {max(seconds, 5):.0f} s"


def is_made(source: Path, out: Path) -> bool:
    """Return whether the folder `out` has the poses of `source`; False if it has no poses.

    Raises PosesError if `out` has poses of other photos.
    """
    held = fingerprint(source)
    with suppress(OSError, json.JSONDecodeError):
        record = json.loads((out / RECORD).read_bytes())
        if record["source"] == held:
            return True
        raise PosesError(
            f"{out} has poses of other photos than {source} has: delete these poses to compute new "
            f"ones, or run `qgs poses {source} --out FOLDER` and use FOLDER in place of the photos"
        )
    return False


def beside(source: Path) -> Path:
    """Return the folder for the poses of `source`: NAME_poses beside it."""
    whole = source.resolve()
    return whole.with_name(f"{whole.stem if source.is_file() else whole.name}_poses")

"""Photos without cameras and videos that a command opens: COLMAP makes their poses first."""

import json
from contextlib import suppress
from pathlib import Path

from filelock import FileLock
from rich.console import Console
from upath import UPath

from qgs_photos.datasets.colmap import Colmap
from qgs_photos.image_files import image_files
from qgs_photos.poses.making import RECORD, Options, fingerprint, make_poses
from qgs_photos.poses.photos import PosesError
from qgs_photos.printing import say

VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")


class ColmapOrPhotos(Colmap):
    """COLMAP's models, which it makes of photos without cameras and of videos."""

    @classmethod
    def posed(cls, path: UPath) -> UPath | None:
        """Return the folder with the poses of `path`, made if need be, beside it in NAME_poses."""
        # anything else is left to the readers of listings, whose errors say what it lacks
        is_video = path.suffix.lower() in VIDEOS and path.is_file()
        if is_video or any(map(image_files, (path, path / "images"))):
            return UPath(posed_folder(Path(str(path))))
        return None


def posed_folder(source: Path) -> Path:
    """Return the poses of the photos or the video `source`, beside it in NAME_poses.

    Makes them if need be. Raises PosesError where they belong to other photos than are there now,
    OSError where they cannot be kept, and as `make_poses`.
    """
    out = beside(source)
    lock = out.with_name(f".{out.name}.lock")
    console = Console(stderr=True)
    try:
        # of several processes that open the same photos the first makes poses, the others wait
        if not is_made(source, out):
            with FileLock(lock):
                if not is_made(source, out):
                    text = "has no camera poses: they are made first, once, and kept in"
                    say(console, f"{source} {text} {out}")
                    for line in make_poses(source, out, Options(), console).summary:
                        say(console, line)
                # Windows keeps it
                with suppress(OSError):
                    lock.unlink()
    except PermissionError as error:
        raise OSError(
            f"{out} cannot be made ({error.strerror}): run `qgs poses {source} --out FOLDER`, and "
            "give that folder"
        ) from error
    return out


def is_made(source: Path, out: Path) -> bool:
    """Return whether `out` has the poses of `source`. Raises PosesError for those of others."""
    held = fingerprint(source)
    with suppress(OSError, json.JSONDecodeError):
        record = json.loads((out / RECORD).read_bytes())
        if record["source"] == held:
            return True
        raise PosesError(
            f"{out} has the poses of what {source} held before: delete it, so that they are made "
            f"anew, or run `qgs poses {source} --out FOLDER` and give that folder"
        )
    return False


def beside(source: Path) -> Path:
    """Return where the poses of `source` are kept."""
    whole = source.resolve()
    return whole.with_name(f"{whole.stem if source.is_file() else whole.name}_poses")

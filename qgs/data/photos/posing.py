"""Photos without cameras, and videos: another distribution makes their poses."""

import os
from pathlib import Path

from upath import UPath

from qgs.data.photos.reader import image_files
from qgs.extensions import function
from qgs.paths import is_local

VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
REFUSE = "QGS_NO_POSES"
"""Environment variable that refuses to make poses, as --no-poses does."""


def posed(path: UPath) -> UPath:
    """A folder with the poses of `path`, a video or photos without cameras; else `path`.

    Raises ValueError where poses are refused, ExtensionError without the plug-in, and as it does.
    """
    video = path.suffix.lower() in VIDEOS and path.is_file()
    if not is_local(path) or not (video or any(map(image_files, (path, path / "images")))):
        return path
    if os.environ.get(REFUSE):
        raise ValueError(f"{path} has no camera poses, and --no-poses ({REFUSE}) wants none")
    return UPath(function("qgs.poses", "folder")(Path(str(path))))

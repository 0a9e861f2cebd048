"""Which source reads a folder, told from what the folder holds."""

from __future__ import annotations

import re

from upath import UPath

from qgs.data.chunks.files import INDEX, SUFFIX
from qgs.data.photos.formats import formats_of

_HASH = re.compile(r"[0-9a-f]{64}")
_BENCHMARK = ("gaussian_splat", "nerfstudio")


def recognised(path: UPath) -> str:
    """The name of the source that reads `path`: qgs/chunks, qgs/dl3dv or qgs/photos.

    Chunks are .torch files, also in train and test. DL3DV is archives, folders named by a hash or
    laid out as its benchmark, also in folders such as 1K. The rest is photos, whose source says
    what it misses. Raises FileNotFoundError when `path` does not exist.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: give the folder of a data set")
    if path.is_file():
        return "qgs/dl3dv" if path.suffix == ".zip" else "qgs/photos"
    if any(_holds_chunks(folder) for folder in (path, path / "train", path / "test")):
        return "qgs/chunks"
    if formats_of(path):
        return "qgs/photos"
    return "qgs/dl3dv" if _holds_dl3dv(path, depth=1) else "qgs/photos"


def _holds_chunks(folder: UPath) -> bool:
    if not folder.is_dir():
        return False
    names = [item.name for item in folder.iterdir()]
    listed = folder.name in {"train", "test"} and INDEX in names
    return listed or any(name.endswith(SUFFIX) for name in names)


def _holds_dl3dv(folder: UPath, depth: int) -> bool:
    """Whether `folder`, or a folder in it, holds a scene as DL3DV publishes them."""
    if any((folder / inside / "transforms.json").is_file() for inside in _BENCHMARK):
        return True
    items = [item for item in folder.iterdir() if not item.name.startswith(".")]
    if any(item.suffix == ".zip" or _HASH.fullmatch(item.name) for item in items):
        return True
    inside = (item for item in items if item.is_dir())
    return depth >= 0 and any(_holds_dl3dv(item, depth - 1) for item in inside)

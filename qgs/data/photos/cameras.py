"""`cameras.json`, as feed-forward projects ship with their demos: c2w, K, photos beside it."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from upath import UPath

from qgs.data.paths import open_file, read_json
from qgs.data.photos.checks import FrameProblem, listed_size
from qgs.data.photos.reader import (
    Listing,
    PhotoFrame,
    PhotoReader,
    existing,
    image_files,
    numbers,
)

_LISTS = ("frames", "cameras", "views")
_NAMES = ("image", "image_path", "file_path", "filename", "file_name", "file", "name", "img_name")
_START = 4_000_000  # bytes of a file that are looked at; a thousand cameras have a tenth of that
_FORM = '{"frames": [{"image": "0.png", "c2w": 4 x 4, "K": 3 x 3}, ...]}'


class CamerasJson(PhotoReader):
    """A list of cameras, or one under `frames`, `cameras` or `views`, or lists `c2w` and `K`.

    A camera is `c2w`, an OpenCV camera-to-world (3 or 4, 4), and `K`, (3, 3) or fx, fy, cx, cy in
    pixels of `w` by `h`, or of the file without these; what all share may stand at the top. Images
    are named by one of `_NAMES`, or are those beside the file, or in images, by name.
    """

    name = "cameras"
    listing = "cameras.json"
    poses = "opencv c2w"

    @classmethod
    def recognises(cls, folder: UPath) -> bool:
        """See `PhotoReader`: other programs give other files this name."""
        file = folder / cls.listing
        if not file.is_file():
            return False
        with open_file(file) as opened:
            start = opened.read(_START)
        return all(key in start for key in (b'"c2w"', b'"K"'))

    @classmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """See `PhotoReader`. Raises ValueError for unnamed images of another number."""
        file = folder / cls.listing
        cameras = _cameras(file, read_json(file, f"write {_FORM}"))
        names = [next((n for k in _NAMES if isinstance(n := c.get(k), str)), "") for c in cameras]
        if not cameras:
            raise ValueError(f"{file} lists no cameras: expected {_FORM}")
        folders = [folder / images] if images else [folder, folder / "images"]
        if any(names):  # relative to the first of the folders that holds some of them
            held = (place for place in folders if existing(place / name for name in names if name))
            place = next(held, folders[0])
        else:
            found = {place: image_files(place) for place in folders if place.is_dir()}
            place, files = max(found.items(), key=lambda item: len(item[1]), default=(folder, []))
            names = [item.name for item in files]
            if len(names) != len(cameras):
                raise ValueError(
                    f"{file} lists {len(cameras)} cameras without names of images, but {place} has "
                    f"{len(names)} images: name them, as in {_FORM}"
                )
        named = zip(cameras, names, strict=True)
        return Listing(file, [_frame(folder, place, *camera) for camera in named])


def _cameras(file: UPath, data: Any) -> list[Mapping[str, Any]]:
    """The entry of each camera, with defaults from the top level. Raises ValueError."""
    top = data if isinstance(data, Mapping) else {}
    given = next((top[key] for key in _LISTS if isinstance(top.get(key), list)), data)
    if not isinstance(given, list):
        columns: Any = [top.get(key) for key in ("c2w", "K", "images")]
        poses, matrices, names = columns
        if not isinstance(poses, list):
            return []
        one = numbers(matrices)  # (4, 4) may be fx, fy, cx, cy of four cameras
        shared = one.shape in ((3, 3), (4,)) or (one.shape == (4, 4) and not one[3, :3].any())
        matrices = [matrices] * len(poses) if shared else matrices
        names = names if isinstance(names, list) and len(names) == len(poses) else [""] * len(poses)
        matrices = matrices if isinstance(matrices, list) else []
        if (count := len(matrices)) != len(poses):
            raise ValueError(f"{file} has {len(poses)} matrices c2w and {count} K: write {_FORM}")
        rows = zip(poses, matrices, names, strict=True)
        given = [{"c2w": c2w, "K": K, "image": name or None} for c2w, K, name in rows]
    return [{**top, **camera} if isinstance(camera, Mapping) else {} for camera in given]


def _frame(folder: UPath, place: UPath, values: Mapping[str, Any], name: str) -> PhotoFrame:
    sides = [values.get(s, values.get(long)) for s, long in (("h", "height"), ("w", "width"))]
    size, problems = None, ()
    if None not in sides:
        size, problems = listed_size(
            *(s if isinstance(s, int | float) else math.nan for s in sides)
        )
    pose, matrix = numbers(values.get("c2w")), numbers(values.get("K"))
    if matrix.shape in ((3, 3), (4, 4)):
        matrix = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]  # fx, fy, cx, cy
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    wrong = [("path", "no image is named")] if not name else []
    if pose.shape != (4, 4):
        wrong.append(("c2w", f"'c2w' has the shape {pose.shape}"))
        pose = np.full((4, 4), np.nan)
    if matrix.shape != (4,):
        wrong.append(("intrinsics", f"'K' has the shape {matrix.shape}"))
        matrix = np.full(4, np.nan)
    fx, fy, cx, cy = matrix.tolist()
    inside = name if place == folder or not name else f"{place.name}/{name}"
    more = (FrameProblem(field, reason, f"write {_FORM}") for field, reason in wrong)
    return PhotoFrame(
        inside, place / name, pose, (fx, fy, cx, cy), size, problems=(*problems, *more)
    )

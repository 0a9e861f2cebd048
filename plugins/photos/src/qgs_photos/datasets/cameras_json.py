"""Read `cameras.json`, a list of cameras and photos as demos of feed-forward projects write it.

Projects name the values differently. The name of a value decides its convention; an ambiguous
name is an error.
"""

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import numpy as np
from upath import UPath

from qgs.data.images import image_size, read_image
from qgs.data.photos.finding import found_files, inside
from qgs.data.photos.reader import (
    FrameProblem,
    Listing,
    PhotoFrame,
    PhotoReader,
    Size,
    image_folder,
    listed_size,
    numbers,
)
from qgs.paths import open_file, read_json
from qgs.wording import warn_once
from qgs_photos.image_files import image_files

_LISTS = ("frames", "cameras", "views")
_NAMES = ("image", "image_path", "file_path", "filename", "file_name", "file", "name", "img_name")
_C2W = ("c2w", "cam2world", "cam_to_world", "camera_to_world", "camtoworld")
_W2C = ("w2c", "world2cam", "world_to_cam", "world_to_camera", "worldtocam")
_OPENGL = ("transform_matrix",)
# Used for both directions.
_OPEN = ("extrinsics", "extrinsic", "pose")
_K = ("K", "intrinsics", "intrinsic", "camera_matrix")
_FOCAL = (("fx", "fl_x"), ("fy", "fl_y"), ("cx",), ("cy",))
# Intrinsics up to here are in parts of the width and height.
_NORMALISED = 3.0
# Bytes of a file that are looked at; a thousand cameras have a tenth of that.
_START = 4_000_000
_NO_POSE = np.full((4, 4), np.nan)
_NO_SIZE = (math.nan, math.nan)
_FORM = '{"frames": [{"image": "0.png", "c2w": 4 x 4, "K": 3 x 3}, ...]}'


class CamerasJson(PhotoReader):
    """Reader of `cameras.json`.

    The file is a list of cameras, has such a list under `frames`, `cameras` or `views`, or maps
    each kind of value to a list with one entry for each camera. Values that all cameras share may
    stand at the top level.

    - Pose: `c2w` or a synonym, OpenCV camera-to-world (3, 4) or (4, 4); `w2c`, world-to-camera;
      `transform_matrix`, camera-to-world with OpenGL axes, as nerfstudio writes it; or `position`
      (3,) and `rotation` (3, 3), camera-to-world, as 3DGS writes them.
    - Intrinsics: `K` or a synonym, (3, 3); or fx, fy, cx, cy, as a list or under these names. Their
      unit is pixels of an image of `w` by `h`, by default the size of the image file. If no value
      is above 3, they are fractions of width and height.
    - Photo: a file name under `image` or another name in `_NAMES`. If no camera names a photo,
      the photos beside the file or in images/ belong to the cameras in the order of file names.
    """

    listing = "cameras.json"

    @classmethod
    def recognises(cls, folder: UPath) -> bool:
        """Return whether `folder` seems to hold a `cameras.json` in the format of this reader.

        The file must contain both `c2w` and `K`, or photos must lie beside it or in images/. A file
        that `qgs reconstruct` wrote has another format and is not recognised.
        """
        file = folder / cls.listing
        if not file.is_file():
            return False
        with open_file(file) as opened:
            start = opened.read(_START)
        # what `qgs reconstruct` writes beside its pictures
        if b'"to_photos"' in start:
            return False
        known = all(key in start for key in (b'"c2w"', b'"K"'))
        return known or any(map(image_files, (folder, folder / "images")))

    @classmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """Read the photos and cameras that the file in `folder` lists.

        images: folder of the photos or of scaled copies, such as images_4; None: the listed photos,
        or those of the default folder. Raises ValueError if the file lists no cameras, or if it
        names no photos and the numbers of cameras and photos differ.
        """
        file = folder / cls.listing
        cameras = _cameras(file, read_json(file, f"write {_FORM}"))
        names = list[str]()
        for camera in cameras:
            given = (camera[key] for key in _NAMES if isinstance(camera.get(key), str))
            names.append(next(given, ""))
        if not cameras:
            raise ValueError(f"{file} lists no cameras: expected {_FORM}")
        if any(names):
            listed = [folder / name for name in names]
            named = [folder / name for name in names if name]
            find = cache(partial(found_files, folder, named, images=images))
        else:
            place = image_folder(folder, images)
            listed = image_files(place)
            if len(listed) != len(cameras):
                raise ValueError(
                    f"{file} lists {len(cameras)} cameras without names of images, but {place} has "
                    f"{len(listed)} images: name the images, as in {_FORM}"
                )
            find = dict
        pairs = zip(cameras, listed, strict=True)
        return Listing(file, [_Camera(file, *pair, find).frame() for pair in pairs])


def _cameras(file: UPath, data: Any) -> list[Mapping[str, Any]]:
    """Return the values of each camera in `data`, the parsed JSON of `file`.

    Cameras without a value of their own get the value at the top level of `data`. Raises ValueError
    if the numbers of poses and intrinsics differ.
    """
    top = data if isinstance(data, Mapping) else {}
    given = next((top[key] for key in _LISTS if isinstance(top.get(key), list)), data)
    if not isinstance(given, list):
        pose = _first(top, (*_C2W, *_W2C, *_OPENGL, *_OPEN))
        matrix = _first(top, _K)
        poses: Any = top.get(pose)
        matrices: Any = top.get(matrix)
        names: Any = top.get("images")
        if not isinstance(poses, list):
            return []
        columns = {pose: poses}
        # (4, 4) may be fx, fy, cx, cy of four cameras
        one = numbers(matrices)
        shared = one.shape in ((3, 3), (4,)) or (one.shape == (4, 4) and not one[3, :3].any())
        if not shared:
            columns[matrix] = matrices if isinstance(matrices, list) else []
            if (count := len(columns[matrix])) != len(poses):
                raise ValueError(
                    f"{file} lists {len(poses)} poses ({pose}), but {count} intrinsics "
                    f"({matrix or 'K'}): list both for every camera, or write {_FORM}"
                )
        if isinstance(names, list) and len(names) == len(poses):
            columns["image"] = names
        given = [
            dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)
        ]
    return [{**top, **camera} if isinstance(camera, Mapping) else {} for camera in given]


def _first(values: Mapping[str, Any], keys: tuple[str, ...]) -> str:
    """Return the first of `keys` that has a value in `values`; "" if no key has one."""
    return next((key for key in keys if values.get(key) is not None), "")


@dataclass
class _Camera:
    """A camera in `cameras.json`, the `file`.

    values: the camera's entry in the file. path: the camera's photo as listed. find: function that
    returns the existing file of each listed photo; called only if the entry has no image size.
    """

    file: UPath
    values: Mapping[str, Any]
    path: UPath
    find: Callable[[], Mapping[UPath, UPath]]
    size: Size | None = None
    problems: list[FrameProblem] = field(default_factory=list)

    def _wrong(self, reason: str) -> None:
        self.problems.append(FrameProblem(reason, f"write {_FORM}"))

    def _pose(self) -> np.ndarray:
        """Return OpenCV camera-to-world (4, 4); NaN if the pose is missing or invalid."""
        values = self.values
        key = _first(values, (*_C2W, *_W2C, *_OPENGL))
        pose = numbers(values.get(key))
        if not key and {"position", "rotation"} <= values.keys():
            rotation, position = (numbers(values[k]) for k in ("rotation", "position"))
            if rotation.shape == (3, 3) and position.shape == (3,):
                pose = np.c_[rotation, position]
        elif not key:
            unclear = _first(values, _OPEN)
            ambiguous = f"{unclear!r} may be camera-to-world or world-to-camera"
            reason = ambiguous if unclear else "it has no pose"
            self._wrong(f"{reason}: expected {_C2W[0]} or {_W2C[0]}")
            return _NO_POSE
        if pose.shape == (3, 4):
            pose = np.vstack([pose, [0, 0, 0, 1]])
        if pose.shape != (4, 4):
            self._wrong(f"{key or 'rotation'!r} has the shape {pose.shape}")
            return _NO_POSE
        if key in _W2C:
            # a singular matrix is told as a pose with NaN
            with suppress(np.linalg.LinAlgError):
                return np.linalg.inv(pose)
            return _NO_POSE
        return pose * [1, -1, -1, 1] if key in _OPENGL else pose

    def _intrinsics(self) -> np.ndarray:
        """Return fx, fy, cx, cy in pixels; NaN if intrinsics are missing or invalid."""
        key = _first(self.values, _K)
        matrix = numbers(self.values.get(key))
        fx, fy, *centre = (self.values.get(_first(self.values, names)) for names in _FOCAL)
        if not key and fx is not None:
            if None in centre and (size := self._photo_size()):
                centre = [size[1] / 2, size[0] / 2]
            matrix = np.append(numbers([fx, fx if fy is None else fy]), numbers(centre))
        if matrix.shape in ((3, 3), (4, 4)):
            matrix = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        if matrix.shape != (4,):
            reason = f"{key!r} has the shape {matrix.shape}" if key else "it has no intrinsics"
            self._wrong(f"{reason}: expected 'K', 3 x 3")
            return np.full(4, np.nan)
        if np.abs(matrix).max() <= _NORMALISED and (size := self._photo_size()):
            warn_once(f"intrinsics <= 3 in {self.file} are read as fractions of width and height")
            height, width = size
            return matrix * [width, height, width, height]
        return matrix

    def _photo_size(self) -> Size | None:
        """Return the listed (H, W), or that of the image file; None if the file is unreadable."""
        if self.size is None:
            with suppress(ValueError):
                self.size = read_image(self.find().get(self.path, self.path), image_size)
        return self.size

    def frame(self) -> PhotoFrame:
        """Return the photo and its camera; the photo's name is its path from the file's folder."""
        values = self.values
        sides = [values.get(s, values.get(long)) for s, long in (("h", "height"), ("w", "width"))]
        if None not in sides:
            # some programs write numbers as text
            plain = numbers(sides)
            self.size, wrong = listed_size(*(plain if plain.shape == (2,) else _NO_SIZE))
            self.problems += wrong
        pose = self._pose()
        # may read the size of the file
        fx, fy, cx, cy = self._intrinsics().tolist()
        folder = self.file.parent
        name = "" if self.path == folder else "/".join(inside(folder, self.path))
        if not name:
            self._wrong("no image is named")
        return PhotoFrame(
            name=name,
            path=self.path,
            c2w=pose,
            intrinsics=(fx, fy, cx, cy),
            size=self.size,
            problems=(*self.problems,),
        )

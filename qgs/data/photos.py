"""`qgs/photos`: a folder of photos with a nerfstudio `transforms.json`."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from pydantic import Field
from torch import Tensor

from qgs.contracts import Scene, SceneSource, Split
from qgs.data.images import CropResize, open_rgb, to_tensor
from qgs.data.transforms_json import PhotoFrame, read_transforms
from qgs.data.undistortion import undistorted
from qgs.types import Cameras, Views

_log = logging.getLogger(__name__)
_CACHE_BYTES = 512 * 2**20
_SAME_ASPECT = 0.01  # relative difference between the file's and the JSON's aspect ratio


class PhotosConfig(SceneSource.Config):
    """Options of `qgs/photos`.

    path: folder that holds transforms.json, absolute or relative to the working directory.
    holdout: every n-th frame is kept for evaluation, from frame n // 2 on; 0 for none. max_frames:
    only the first frames of the file, 0 for all. background: RGB behind transparent pixels.
    """

    path: str
    holdout: int = Field(default=8, ge=0)
    max_frames: int = Field(default=0, ge=0)
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)


class PhotoScene(Scene):
    """The photos of one folder, in the file's order. World: that of the file's poses."""

    def __init__(
        self,
        name: str,
        frames: Sequence[PhotoFrame],
        image_size: tuple[int, int],
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        holdout: int = 0,
    ) -> None:
        self.name = name
        self.held_out = tuple(range(holdout // 2, len(frames), holdout)) if holdout else ()
        self._frames, self._background = frames, background
        self._sizes = [_file_size(frame) for frame in frames]
        self._crops = [CropResize(size, image_size) for size in self._sizes]
        self._cache: OrderedDict[int, np.ndarray] = OrderedDict()
        self._kept = max(_CACHE_BYTES // (3 * image_size[0] * image_size[1]), 1)
        intrinsics = [
            crop.intrinsics(torch.tensor(_at_size(frame, size), dtype=torch.float64))
            for frame, size, crop in zip(frames, self._sizes, self._crops, strict=True)
        ]
        c2w = torch.from_numpy(np.stack([frame.c2w for frame in frames])).float()
        self._cameras = Cameras(c2w, torch.stack(intrinsics).float(), image_size)

    @property
    def cameras(self) -> Cameras:
        """See `Scene`."""
        return self._cameras

    def images(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`. Raises ValueError for a file that cannot be decoded."""
        return to_tensor(np.stack([self._image(frame) for frame in frames]))

    def _image(self, index: int) -> np.ndarray:
        if index in self._cache:
            return self._cache[index]
        frame = self._frames[index]
        image: Image.Image = open_rgb(frame.path, self._background)
        if any(frame.distortion):
            image = undistorted(image, _at_size(frame, self._sizes[index]), frame.distortion)
        pixels = self._crops[index].image(image)
        self._cache[index] = pixels
        if len(self._cache) > self._kept:
            self._cache.popitem(last=False)
        return pixels


def _file_size(frame: PhotoFrame) -> tuple[int, int]:
    """(H, W) of the image file, which may be a smaller or larger copy of what the JSON says."""
    try:
        with Image.open(frame.path) as image:
            width, height = image.size
    except OSError as error:
        raise ValueError(
            f"{frame.path} cannot be read as an image ({error}): replace the file, or remove its "
            "frame from transforms.json"
        ) from error
    if frame.size is not None:
        said_height, said_width = frame.size
        if abs(width * said_height / (height * said_width) - 1) > _SAME_ASPECT:
            raise ValueError(
                f"{frame.path} is {width} x {height} pixels, but transforms.json says "
                f"{said_width} x {said_height}, another aspect ratio: the intrinsics cannot be "
                "scaled. Give the original images, or correct 'w' and 'h'"
            )
    return height, width


def _at_size(frame: PhotoFrame, size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Intrinsics in pixels of the image file of `size`, scaled from the JSON's size."""
    height, width = frame.size or size
    x, y = size[1] / width, size[0] / height
    fx, fy, cx, cy = frame.intrinsics
    return fx * x, fy * y, cx * x, cy * y


def present_frames(folder: Path) -> tuple[list[PhotoFrame], list[str]]:
    """The frames whose image files exist, and the paths of the others, which are also logged.

    Raises FileNotFoundError when fewer than two images exist.
    """
    frames = read_transforms(folder)
    present = [frame for frame in frames if frame.path.is_file()]
    missing = [str(frame.path) for frame in frames if not frame.path.is_file()]
    if len(present) < 2:
        raise FileNotFoundError(
            f"{folder}/transforms.json names {len(frames)} images, of which {len(present)} exist "
            f"and 2 are needed; the first missing one is {missing[0] if missing else 'none'}"
        )
    if missing:
        _log.warning(
            "%d of %d images of %s are missing: %s", len(missing), len(frames), folder,
            ", ".join(missing),
        )  # fmt: skip
    return present, missing


class PhotosSource(SceneSource):
    """One folder of photos; both splits are the same scene, with held-out frames.

    missing: paths of the images that transforms.json names and that do not exist.
    """

    name = "photos"
    Config = PhotosConfig

    def __init__(self, config: PhotosConfig) -> None:
        super().__init__(config)
        folder = Path(config.path).expanduser()
        frames, self.missing = present_frames(folder)
        frames = frames[: config.max_frames or None]
        self._scenes = (
            PhotoScene(
                folder.resolve().name, frames, config.image_size, config.background, config.holdout
            ),
        )

    def scenes(self, split: Split) -> Sequence[Scene]:
        """See `SceneSource`."""
        return self._scenes


def read_photos(
    path: str | Path, image_size: tuple[int, int], frames: Sequence[int] | None = None
) -> Views:
    """Views (1, V) of a photo folder, in the world of its poses; all frames unless some are named.

    Raises FileNotFoundError and ValueError as `PhotosSource`, IndexError for frames out of range.
    """
    folder = Path(path).expanduser()
    scene = PhotoScene(folder.resolve().name, present_frames(folder)[0], image_size)
    chosen = list(range(len(scene))) if frames is None else list(frames)
    outside = [frame for frame in chosen if not 0 <= frame < len(scene)]
    if outside:
        raise IndexError(f"{folder} has frames 0 to {len(scene) - 1}, asked for {outside}")
    cameras = scene.cameras[chosen]
    return Views(
        scene.images(chosen)[None],
        Cameras(cameras.c2w[None], cameras.intrinsics[None], cameras.size),
    )

"""`qgs/photos`: a folder of photos with their cameras, or a folder of such folders."""

import io
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, partial
from operator import attrgetter
from typing import ClassVar

import numpy as np
import torch
from PIL import Image
from pydantic import Field, field_validator
from torch import Tensor
from upath import UPath

from qgs.contracts import OptionError, SceneSource, SceneSourceConfig
from qgs.data.frames import held_out_frames
from qgs.data.images import (
    TURN,
    TURNED,
    CropResize,
    alpha_mask,
    image_size,
    open_depth,
    open_mask,
    open_rgb,
    orientation,
    to_tensor,
)
from qgs.data.lenses import Mode, Size, undistorted, whole_zoom
from qgs.data.photos import formats_of, read_listing, readers
from qgs.data.photos.checks import refuse_fatal_problems, refuse_outside, size_problems
from qgs.data.photos.reader import PhotoFrame, existing
from qgs.data.photos.turning import turned, turned_size, upright
from qgs.data.scenes import BoundedCache, EncodedFrame, EncodedScene, LazyScenes, LazySource
from qgs.paths import is_local, opened_path, read_file
from qgs.types import Cameras
from qgs.wording import listed, warn_once


class PhotosConfig(SceneSource.Config):
    """Options of `qgs/photos`."""

    path: str
    """Folder of one scene, of folders of scenes, or with such folders in train and test: absolute,
    relative to the working directory, or an fsspec URL. Photos without cameras and videos need
    `qgs poses` first."""
    format: str = "auto"
    """How cameras are listed: nerfstudio, colmap, or a format of a plug-in; auto is the first that
    a folder holds."""
    images: str | None = None
    """Folder of photos to read instead of the listed one, such as images_4."""
    outside: bool = False
    """Read photos outside of the folder too, by absolute paths or `..`; links are followed."""
    holdout: int = Field(default=8, ge=0)
    """Every n-th frame is kept for evaluation, from frame n // 2 on, or the middle one of fewer; 0
    for none. A listing's own split goes first."""
    max_frames: int = Field(default=0, ge=0)
    """Only the first frames of a listing; 0 for all."""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """RGB in [0, 1] behind transparent pixels."""
    depth_unit: float = Field(default=1e-3, gt=0)
    """World units per number of a depth map; nerfstudio writes millimetres (0.001)."""

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, format: str) -> str:
        if format not in (known := ("auto", *readers())):
            raise OptionError(f"must be a format of photos, got {format!r}", f"use {listed(known)}")
        return format


def image_cache(limit: int = 512 * 2**20) -> BoundedCache[np.ndarray]:
    """A cache of decoded images, with a limit in bytes."""
    return BoundedCache(limit, attrgetter("nbytes"))


class PhotoScene(EncodedScene):
    """A listing's photos, in its world and order. cache: shared. Raises as `present_frames`."""

    def __init__(
        self, name: str, folder: UPath, config: PhotosConfig, cache: BoundedCache[np.ndarray]
    ) -> None:
        self.name, self.folder, self._config, self._cache = name, folder, config, cache
        options = config.format, config.images, config.outside
        frames, self.missing = present_frames(folder, *options)
        self._frames = frames = [*map(upright, frames[: config.max_frames or None])]
        times = [frame.time for frame in frames if frame.time is not None]
        self.times = torch.tensor(times, dtype=torch.float64) if len({*times}) > 1 else None
        self.held_out = held_out_frames(len(frames), config.holdout)
        if any(frame.split for frame in frames):
            self.held_out = tuple(i for i, frame in enumerate(frames) if frame.split == "test")

    def __len__(self) -> int:
        return len(self._frames)

    @cached_property
    def cameras(self) -> Cameras:  # pyright: ignore[reportIncompatibleVariableOverride]
        """See `Scene`; float64. Raises ValueError where a photo and its listed size disagree.

        The header of one photo stands for those of its folder that are listed with the same size.
        """
        known: dict[object, Size] = {}
        intrinsics: list[Tensor] = []
        for frame in self._frames:
            kind = (frame.path.parent, frame.size, frame.turns) if frame.size else frame.path
            if kind not in known:
                known[kind] = _checked(image_size(frame.path), frame, frame.path)
            size = known[kind]
            stored = torch.tensor(frame.at_size(size), dtype=torch.float64)
            intrinsics.append(self._crop(frame, size).intrinsics(stored))
        c2w = torch.from_numpy(np.stack([frame.c2w for frame in self._frames]))
        return Cameras(c2w, torch.stack(intrinsics), self._config.image_size)

    def images(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`. Raises ValueError for a file that cannot be decoded."""
        return to_tensor(self._stacked(self._image, frames))

    def masks(self, frames: Sequence[int]) -> Tensor | None:
        """See `Scene`; 1 everywhere for a photo without a mask in a scene that has some."""
        if all(frame.mask is None for frame in self._frames):
            return None
        masks = self._stacked(self._mask, frames)
        return torch.from_numpy(masks)[:, None].float().div_(255)

    def depths(self, frames: Sequence[int]) -> Tensor | None:
        """See `Scene`; 0 in frames without a map. None where none of `frames` has one."""
        if all(self._frames[i].depth is None for i in frames):
            return None
        return torch.from_numpy(self._stacked(self._depth, frames))[:, None]

    def frame_name(self, frame: int) -> str:
        """See `Scene`: the image file, relative to the scene's folder."""
        return self._frames[frame].name

    def stored_size(self, frame: int) -> Size:
        """See `Scene`."""
        photo = self._frames[frame]
        return _checked(image_size(photo.path), photo, photo.path)

    def zoom(self, frame: int) -> float:
        """See `Scene`."""
        return self._crop(self._frames[frame], self.stored_size(frame)).zoom

    def encoded(self, frame: int) -> EncodedFrame:
        """See `EncodedScene`."""
        photo, size = self._frames[frame], self.stored_size(frame)
        buffer, pixels = io.BytesIO(), io.BytesIO()
        if photo.mask is not None:
            turned(Image.fromarray(_whole_mask(photo)), photo).save(buffer, "png")
        if photo.turns:
            turned(open_rgb(photo.path, self._config.background), photo).save(pixels, "png")
        return EncodedFrame(
            photo.name, pixels.getvalue() or read_file(photo.path), photo.c2w, photo.at_size(size),
            size, photo.lens, buffer.getvalue() or None, self._config.background,
        )  # fmt: skip

    def _stacked(
        self, read: Callable[[PhotoFrame], np.ndarray], frames: Sequence[int]
    ) -> np.ndarray:
        """(F, H, W, ...) of what `read` makes of the frames, or made before."""
        made = partial(self._made, read)
        paths = [self._frames[frame].path for frame in frames]
        if all(is_local(path) or path.protocol == "zip" for path in paths):
            return np.stack([made(frame) for frame in frames])
        with ThreadPoolExecutor(8) as pool:  # a store answers slowly, but several at a time
            return np.stack(list(pool.map(made, frames)))

    def _made(self, read: Callable[[PhotoFrame], np.ndarray], frame: int) -> np.ndarray:
        key = self.name, read.__name__, frame
        return self._cache.get(key, lambda: read(self._frames[frame]))

    def _image(self, frame: PhotoFrame) -> np.ndarray:
        image = open_rgb(frame.path, self._config.background)
        if not frame.turns and orientation(image) != 1:
            warn_once(f"photos in {frame.path.parent} {TURNED}: {TURN}")
        return self._delivered(image, frame, frame.path)

    def _mask(self, frame: PhotoFrame) -> np.ndarray:
        if frame.mask is None:
            return np.full(self._config.image_size, 255, np.uint8)
        return self._delivered(Image.fromarray(_whole_mask(frame)), frame, frame.mask)

    def _depth(self, frame: PhotoFrame) -> np.ndarray:
        if frame.depth is None:
            return np.zeros(self._config.image_size, np.float32)
        depth = open_depth(frame.depth, self._config.depth_unit)
        return self._delivered(Image.fromarray(depth), frame, frame.depth, "nearest")

    def _delivered(
        self, image: Image.Image, frame: PhotoFrame, file: UPath, mode: Mode = "bilinear"
    ) -> np.ndarray:
        """The content of `file`, upright without distortion, at the delivered size."""
        if file != frame.path and frame.size is None:  # a mask or depth map follows the photo
            frame = replace(frame, size=image_size(frame.path))
        size = _checked((image.height, image.width), frame, file)
        image = turned(image, frame)
        if frame.lens is not None:
            pixels = undistorted(np.array(image), frame.at_size(size), frame.lens, mode)
            image = Image.fromarray(pixels)
        kernel = Image.Resampling.NEAREST if mode == "nearest" else Image.Resampling.LANCZOS
        return self._crop(frame, size).image(image, kernel)

    def _crop(self, frame: PhotoFrame, size: Size) -> CropResize:
        """Of a photo of `size` without distortion: what the lens did not see is cut off."""
        target = self._config.image_size
        zoom = whole_zoom(frame.at_size(size), frame.lens, size, target)
        return CropResize(size, target, zoom)


def _whole_mask(frame: PhotoFrame) -> np.ndarray:
    assert frame.mask is not None
    return alpha_mask(frame.path) if frame.mask == frame.path else open_mask(frame.mask)


def _checked(size: tuple[int, ...], frame: PhotoFrame, file: UPath) -> Size:
    """(H, W) of `file`, upright, which is one of the frame, if it goes with what is listed."""
    height, width = turned_size((size[0], size[1]), frame)
    for problem in size_problems((height, width), frame.size):
        raise ValueError(f"{file}: {problem}")
    return height, width


class PhotosSource(LazySource):
    """Photos of one scene or of many; both splits are the same scenes, with held-out frames.

    Only where the folder has scenes in `train` and `test`, the splits are those. A single scene is
    opened at once; of many, each is when it is asked for. Raises as `present_frames`.
    """

    name = "photos"
    Config = PhotosConfig
    tells_times: ClassVar[bool] = True
    not_in_protocol: ClassVar[frozenset[str]] = frozenset({"path", "outside"})
    split_options: ClassVar[frozenset[str]] = frozenset({"holdout", "max_frames"})

    def __init__(self, config: PhotosConfig) -> None:
        super().__init__(config)
        root = opened_path(config.path)
        train = test = {folder_name(root): root}
        if root.is_dir() and not formats_of(root):
            train, test = (_folders(root / part, config) for part in ("train", "test"))
            if not (train and test):
                train = test = _folders(root, config) or {folder_name(root): root}
        scenes = LazyScenes(train, partial(PhotoScene, config=config, cache=image_cache()))
        self.splits = {"train": scenes, "test": scenes}
        if train is not test:
            opener = partial(PhotoScene, config=config, cache=image_cache())
            self.splits["test"] = LazyScenes(test, opener)
        elif len(scenes) == 1:
            _ = scenes[0].cameras  # raises at once what is wrong

    @classmethod
    def recognises(cls, path: UPath) -> bool:
        """A listing of cameras in the folder. Any other folder is opened as photos for want of a
        source that recognises it, folders of scenes included.
        """
        return bool(formats_of(path))

    @classmethod
    def trains_on(cls, root: UPath, path: UPath) -> bool:
        """See `SceneSource`: also a scene in a folder of scenes, or in its train."""
        inside = path in (root / path.name, root / "train" / path.name)
        return path == root or (inside and bool(formats_of(path)))

    @classmethod
    def config_for(
        cls, path: str, image_size: tuple[int, int], trained: SceneSourceConfig | None
    ) -> SceneSourceConfig:
        """See `SceneSource`; no frame is held out."""
        config = super().config_for(path, image_size, trained)
        return config.model_copy(update={"holdout": 0})


def _folders(root: UPath, config: PhotosConfig) -> dict[str, UPath]:
    """The folders in `root` that hold a scene in the wanted format, by name."""
    if not root.is_dir():
        return {}
    inside = sorted((item for item in root.iterdir() if item.is_dir()), key=lambda item: item.name)
    held = {folder: formats_of(folder) for folder in inside}
    wanted = [f for f in inside if held[f] and config.format in ("auto", *held[f])]
    left = [folder.name for folder in inside if folder not in wanted]
    if wanted and left:
        warn_once(
            f"{len(left)} of {len(inside)} folders in {root} hold no photos with cameras and are "
            f"left out: {listed(left)}"
        )
    return {folder.name: folder for folder in wanted}


def folder_name(folder: UPath) -> str:
    """The name of the scene in `folder`."""
    return folder.resolve().name or "photos"


def present_frames(
    folder: UPath, format: str = "auto", images: str | None = None, outside: bool = False
) -> tuple[list[PhotoFrame], list[str]]:
    """The frames of the listing's splits whose image files exist, and the paths of the others.

    What is left out is logged. Raises FileNotFoundError when fewer than two images or a mask do not
    exist, ValueError for poses and intrinsics that cannot be right.
    """
    listing = read_listing(folder, format, images)
    if not outside:
        refuse_outside(folder, listing)
    frames = [frame for frame in listing.frames if frame.split != "unused"]
    if len(frames) < len(listing.frames):
        warn_once(
            f"{len(listing.frames) - len(frames)} of {len(listing.frames)} frames of "
            f"{listing.file} are in none of its splits and are left out"
        )
    there = existing(frame.path for frame in frames)
    present = [frame for frame in frames if frame.path in there]
    missing = [str(frame.path) for frame in frames if frame.path not in there]
    # before the count: a wrong listing explains missing images
    refuse_fatal_problems(listing.file, present if len(present) > 1 else frames)
    if len(present) < 2:
        raise FileNotFoundError(
            f"{listing.file} names {len(frames)} images, but {len(present)} exist "
            f"and 2 are needed: add {listed(missing, 3) or 'photos'}"
        )
    if missing:
        warn_once(
            f"{len(missing)} of {len(frames)} images of {folder} are missing: {listed(missing, 3)}"
        )
    masks = [frame.mask for frame in present if frame.mask is not None]
    absent = sorted(set(map(str, masks)) - set(map(str, existing(masks))))
    if absent:
        raise FileNotFoundError(
            f"{listing.file} names {len(masks)} masks, but {len(absent)} do not exist: "
            f"{listed(absent, 3)}. Add them, or remove their 'mask_path'"
        )
    return present, missing

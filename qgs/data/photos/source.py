"""Data source `qgs/photos`: a folder of photos and cameras, or a folder of such folders."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from operator import attrgetter

import numpy as np
import torch
from PIL import Image
from pydantic import NonNegativeInt, PositiveFloat, field_validator
from torch import Tensor
from upath import UPath

from qgs.contracts import OptionError, Scene, SceneSource, SceneSourceConfig
from qgs.data.images import (
    TURN,
    TURNED,
    CropResize,
    decode_alpha,
    decode_depth,
    decode_mask,
    decode_rgb,
    image_size,
    opened_image,
    orientation,
    read_image,
    to_tensor,
)
from qgs.data.photos import formats_of, present_frames, readers
from qgs.data.photos.reader import PhotoFrame, Size, size_problems
from qgs.data.scenes import BoundedCache, LazyScenes, LazySource
from qgs.data.view_samplers import held_out_frames
from qgs.paths import is_local, listing, opened_path
from qgs.types import Cameras
from qgs.wording import listed, warn_once

_CACHED = 512 * 2**20
"""Size in bytes of the cache of decoded images."""
_TURNS = {3: 2, 6: 1, 8: 3}
"""Clockwise quarter turns by EXIF orientation. Orientations that mirror are ignored."""


class PhotosConfig(SceneSource.Config):
    """Options of the data source `qgs/photos`."""

    path: str
    """Folder of one scene, folder of scenes, or folder with the subfolders train and test, which
    hold scenes. Absolute, relative to the working directory, or a URL of fsspec. For a video, or
    for photos without cameras, run `qgs poses` first."""
    format: str = "auto"
    """Format of the camera listing: nerfstudio, or a format of a plug-in, such as colmap. auto uses
    the first format in which the folder lists cameras."""
    images: str | None = None
    """Folder with scaled copies of the photos to read, such as images_4. null reads the listed
    photos."""
    outside: bool = False
    """Allow listings to name files outside of the folder, by absolute paths or `..`. Links are
    always followed."""
    holdout: NonNegativeInt = 8
    """Number n: every nth frame, starting at frame n // 2, is held out for evaluation. In scenes
    of fewer than n frames it is the middle frame. 0: none is held out. Splits in the listing take
    precedence."""
    max_frames: NonNegativeInt = 0
    """Number of frames to read from the start of a listing. 0 reads all frames."""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """RGB colour in [0, 1] behind transparent pixels."""
    depth_unit: PositiveFloat = 1e-3
    """Depth in world units that the value 1 in a depth map means. The default is for millimetres,
    as nerfstudio writes them."""

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, format: str) -> str:
        known = ("auto", *readers())
        if format not in known:
            raise OptionError(f"must be a format of photos, got {format!r}", f"use {listed(known)}")
        return format


class PhotoScene(Scene):
    """Scene of listed photos, in the coordinates and the order of the listing.

    cache: decoded images, shared by several scenes. Raises the errors of `present_frames`.
    """

    def __init__(
        self, name: str, folder: UPath, config: PhotosConfig, cache: BoundedCache[np.ndarray]
    ) -> None:
        self.name = name
        self.folder = folder
        self.config = config
        self._cache = cache
        frames, self.missing = present_frames(folder, config.format, config.images, config.outside)
        self.photos = frames = [*map(upright, frames[: config.max_frames or None])]
        times = [frame.time for frame in frames if frame.time is not None]
        self.times = torch.tensor(times, dtype=torch.float64) if len({*times}) > 1 else None
        # Splits in a listing override the option.
        if any(frame.split for frame in frames):
            self.held_out = tuple(i for i, frame in enumerate(frames) if frame.split == "test")
        else:
            self.held_out = held_out_frames(len(frames), config.holdout)

    def __len__(self) -> int:
        return len(self.photos)

    @cached_property
    def cameras(self) -> Cameras:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Cameras of all frames, in float64, for the photos after crop and resize.

        Of all photos in a folder with the same listed size, only one is opened. Raises ValueError
        if the aspect ratio of this photo is not that of the listed size.
        """
        sizes: dict[object, Size] = {}
        intrinsics: list[Tensor] = []
        for number, frame in enumerate(self.photos):
            alike = (frame.path.parent, frame.size, frame.turns) if frame.size else frame.path
            if alike not in sizes:
                sizes[alike] = self.stored_size(number)
            stored = torch.tensor(frame.at_size(sizes[alike]), dtype=torch.float64)
            intrinsics.append(self._crop(frame, sizes[alike]).intrinsics(stored))
        c2w = torch.from_numpy(np.stack([frame.c2w for frame in self.photos]))
        return Cameras(c2w, torch.stack(intrinsics), self.config.image_size)

    def images(self, frames: Sequence[int]) -> Tensor:
        """Read the photos of `frames`; raise ValueError for a file that cannot be decoded."""
        return to_tensor(self._stacked(self._image, frames))

    def masks(self, frames: Sequence[int]) -> Tensor | None:
        """Read the masks of `frames`; None if no photo of the scene has a mask.

        If only some photos have masks, the masks of the other photos are 1 everywhere.
        """
        if all(frame.mask is None for frame in self.photos):
            return None
        masks = self._stacked(self._mask, frames)
        return torch.from_numpy(masks)[:, None].float().div_(255)

    def depths(self, frames: Sequence[int]) -> Tensor | None:
        """Read the depth maps of `frames`; None if none of them has one.

        A frame without a depth map gets 0 everywhere.
        """
        if all(self.photos[i].depth is None for i in frames):
            return None
        return torch.from_numpy(self._stacked(self._depth, frames))[:, None]

    def frame_name(self, frame: int) -> str:
        """Return the path of the image file relative to the scene's folder."""
        return self.photos[frame].name

    def stored_size(self, frame: int) -> Size:
        """Return the size (H, W) in pixels of the image file, after turning the image upright."""
        photo = self.photos[frame]
        return _checked(read_image(photo.path, image_size), photo, photo.path)

    def _stacked(
        self, read: Callable[[PhotoFrame], np.ndarray], frames: Sequence[int]
    ) -> np.ndarray:
        """Return the results of `read` for F frames, stacked to (F, H, W, ...), and cache them."""

        def cached(frame: int) -> np.ndarray:
            key = (self.name, read.__name__, frame)
            return self._cache.get(key, lambda: read(self.photos[frame]))

        paths = [self.photos[frame].path for frame in frames]
        if all(is_local(path) or path.protocol == "zip" for path in paths):
            return np.stack([*map(cached, frames)])
        # An object store answers slowly, but takes several requests at a time.
        with ThreadPoolExecutor(8) as pool:
            return np.stack([*pool.map(cached, frames)])

    def _image(self, frame: PhotoFrame) -> np.ndarray:
        image = read_image(frame.path, partial(decode_rgb, background=self.config.background))
        if not frame.turns and orientation(image) != 1:
            warn_once(f"photos in {frame.path.parent} {TURNED}: {TURN}")
        return self._delivered(image, frame, frame.path)

    def _mask(self, frame: PhotoFrame) -> np.ndarray:
        if frame.mask is None:
            return np.full(self.config.image_size, 255, np.uint8)
        return self._delivered(whole_mask(frame), frame, frame.mask)

    def _depth(self, frame: PhotoFrame) -> np.ndarray:
        if frame.depth is None:
            return np.zeros(self.config.image_size, np.float32)
        depth = read_image(frame.depth, partial(decode_depth, unit=self.config.depth_unit))
        return self._delivered(Image.fromarray(depth), frame, frame.depth, nearest=True)

    def _delivered(
        self, image: Image.Image, frame: PhotoFrame, file: UPath, nearest: bool = False
    ) -> np.ndarray:
        """Turn `image`, the content of `file`, upright; then undistort, crop and resize it."""
        # A mask or depth map follows the photo.
        if file != frame.path and frame.size is None:
            frame = replace(frame, size=read_image(frame.path, image_size))
        size = _checked((image.height, image.width), frame, file)
        image = turned(image, frame)
        if frame.lens is not None:
            pixels = frame.lens.undistorted(np.array(image), frame.at_size(size), nearest)
            image = Image.fromarray(pixels)
        # Averaging depths at an edge would create a surface that does not exist.
        kernel = Image.Resampling.NEAREST if nearest else Image.Resampling.LANCZOS
        return self._crop(frame, size).image(image, kernel)

    def _crop(self, frame: PhotoFrame, size: Size) -> CropResize:
        """Return the centre crop that leaves out the black edges of an undistorted photo.

        size: (H, W) of the photo.
        """
        target = self.config.image_size
        lens = frame.lens
        zoom = 1.0 if lens is None else lens.whole_zoom(frame.at_size(size), size, target)
        return CropResize(size, target, zoom)


def whole_mask(frame: PhotoFrame) -> Image.Image:
    """Read a photo's whole mask, as stored; raise ValueError for an unreadable file."""
    assert frame.mask is not None
    decode = decode_alpha if frame.mask == frame.path else decode_mask
    return Image.fromarray(read_image(frame.mask, decode))


def _checked(size: Size, frame: PhotoFrame, file: UPath) -> Size:
    """Return the upright (H, W) of the image `file`, whose stored (H, W) is `size`.

    Raises ValueError if the aspect ratio is not that of the size listed for `frame`.
    """
    size = turned_size(size, frame)
    for problem in size_problems(size, frame.size):
        raise ValueError(f"{file}: {problem}")
    return size


class PhotosSource(LazySource):
    """Data source for photos of one scene or many scenes.

    The training split and the test split have the same scenes; test views are held-out frames. But
    if the folder has scenes in the subfolders `train` and `test`, these are the splits. A single
    scene is opened immediately; many scenes are opened when needed. Raises the errors of
    `present_frames`.
    """

    name = "photos"
    Config = PhotosConfig
    tells_times = True
    not_in_protocol = frozenset({"path", "outside"})
    split_options = frozenset({"holdout", "max_frames"})

    def __init__(self, config: PhotosConfig) -> None:
        super().__init__(config)
        root = opened_path(config.path)

        def scenes(folders: dict[str, UPath]) -> LazyScenes:
            cache = BoundedCache[np.ndarray](_CACHED, attrgetter("nbytes"))
            return LazyScenes(folders, partial(PhotoScene, config=config, cache=cache))

        folders = {folder_name(root): root}
        if root.is_dir() and not formats_of(root):
            train = _folders(root / "train", config)
            test = _folders(root / "test", config)
            if train and test:
                self.splits = {"train": scenes(train), "test": scenes(test)}
                return
            folders = _folders(root, config) or folders
        both = scenes(folders)
        self.splits = {"train": both, "test": both}
        if len(both) == 1:
            # Raises errors now, before training starts.
            _ = both[0].cameras

    @classmethod
    def recognises(cls, path: UPath) -> bool:
        """Return whether the folder `path` lists cameras.

        A folder that no data source recognises, such as a folder of scenes, is opened by
        `qgs/photos`.
        """
        return bool(formats_of(path))

    @classmethod
    def trains_on(cls, root: UPath, path: UPath) -> bool:
        """Return whether training on `root` reads `path`.

        True if `path` is `root`, or a scene in `root` or in its subfolder `train`.
        """
        inside = path in (root / path.name, root / "train" / path.name)
        return path == root or (inside and bool(formats_of(path)))

    @classmethod
    def config_for(
        cls, path: str, image_size: tuple[int, int], trained: SceneSourceConfig | None
    ) -> SceneSourceConfig:
        """Return options that open all photos at `path` for a model trained on other data.

        No frame is held out. trained: options of the training data; None if unknown.
        """
        config = super().config_for(path, image_size, trained)
        return config.model_copy(update={"holdout": 0})


def _folders(root: UPath, config: PhotosConfig) -> dict[str, UPath]:
    """Return by name the subfolders of `root` that hold a scene in `config.format`."""
    wanted: dict[str, UPath] = {}
    others: list[str] = []
    for folder in sorted(filter(UPath.is_dir, listing(root)), key=lambda item: item.name):
        held = formats_of(folder)
        if held and config.format in ("auto", *held):
            wanted[folder.name] = folder
        else:
            others.append(folder.name)
    if wanted and others:
        warn_once(
            f"{len(others)} of {len(wanted) + len(others)} folders in {root} are left out, because "
            f"they have no photos with cameras: {listed(others)}"
        )
    return wanted


def folder_name(folder: UPath) -> str:
    """Return the name of the scene in `folder`: the folder's name, or "photos" if it has none."""
    return folder.resolve().name or "photos"


def upright(frame: PhotoFrame) -> PhotoFrame:
    """Return `frame` with camera and lens turned upright as the photo's EXIF orientation says.

    If only the upright photo has the listed size, the listed camera is upright already and is not
    turned. If the stored photo has this size too, as for squares and half turns, the listed camera
    belongs to the stored pixels and is turned. Frames in an object store are not turned.
    """
    # In an object store, each header would be a request.
    if not is_local(frame.path) or not frame.path.is_file():
        return frame
    size, turns = _header(str(frame.path), frame.path.stat().st_mtime_ns)
    if not turns:
        return frame
    frame = replace(frame, turns=turns)
    if not _quarters(_swapped(size), frame):
        return frame
    if turns % 2 and size[0] == size[1]:
        warn_once(f"turned square photos in {frame.path.parent} and their poses upright: {TURN}")
    frame = replace(frame, size=frame.size or size)
    for _ in range(turns):
        frame = _quarter(frame)
    return frame


def turned_size(size: Size, frame: PhotoFrame) -> Size:
    """Return the upright (H, W) of a photo, mask or depth map of `frame` with the stored `size`."""
    return _swapped(size) if _quarters(size, frame) % 2 else size


def turned(image: Image.Image, frame: PhotoFrame) -> Image.Image:
    """Turn a photo, mask or depth map of `frame` upright unless its pixels are upright already."""
    quarters = _quarters((image.height, image.width), frame)
    # Pixels are moved, not interpolated; the angle is counterclockwise.
    return image.rotate(-90 * quarters, expand=True) if quarters else image


def _swapped(size: Size) -> Size:
    return size[1], size[0]


def _quarters(size: Size, frame: PhotoFrame) -> int:
    """Return how many clockwise quarter turns bring a file of `size` (H, W) upright."""
    fits, fits_turned = (not any(size_problems(own, frame.size)) for own in (size, _swapped(size)))
    return 0 if frame.turns % 2 and fits and not fits_turned else frame.turns


@lru_cache(maxsize=2**16)
def _header(path: str, changed: int) -> tuple[Size, int]:
    """Return the stored (H, W) of an image file, and the quarter turns that make it upright.

    For a file that is no image, return (1, 1) and 0. changed: time of the file's last change; if it
    differs from the cached one, the file is read again.
    """
    try:
        with open(path, "rb") as file, opened_image(file) as image:
            return (image.height, image.width), _TURNS.get(orientation(image), 0)
    except OSError:
        return (1, 1), 0


def _quarter(frame: PhotoFrame) -> PhotoFrame:
    """Return `frame` with camera, size and lens turned clockwise by 90 degrees."""
    assert frame.size is not None
    height, width = frame.size
    fx, fy, cx, cy = frame.intrinsics
    return replace(
        frame,
        size=(width, height),
        # The new x axis is the old -y, the new y the old x.
        c2w=frame.c2w[:, [1, 0, 2, 3]] * [-1.0, 1.0, 1.0, 1.0],
        intrinsics=(fy, fx, height - cy, cx),
        lens=frame.lens and frame.lens.turned(),
    )

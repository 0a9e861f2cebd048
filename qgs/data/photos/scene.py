"""Photos of one listing as a scene: decoded when asked for, pinhole, at the delivered size."""

from __future__ import annotations

import io
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from upath import UPath

from qgs.contracts import Scene
from qgs.data.images import CropResize, open_rgb, to_tensor
from qgs.data.lazy import BoundedCache
from qgs.data.lenses import Lens
from qgs.data.photos.frames import (
    PhotoFrame,
    Size,
    alpha_mask,
    image_size,
    nearest,
    open_depth,
    open_mask,
    size_faults,
    undistorted,
)
from qgs.types import Cameras


@dataclass(frozen=True)
class EncodedFrame:
    """A photo as it is stored, and the camera that took it.

    data, mask: bytes of image files; mask None for a frame without one. c2w: (4, 4) float64, OpenCV
    axes. intrinsics: fx, fy, cx, cy in pixels of the stored photo, whose size is (H, W).
    lens: None for a pinhole. background: RGB in [0, 1] behind transparent pixels.
    """

    name: str
    data: bytes
    c2w: np.ndarray
    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    lens: Lens | None = None
    mask: bytes | None = None
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)


class EncodedScene(Scene):
    """A scene that is stored as image files."""

    @abstractmethod
    def encoded(self, frame: int) -> EncodedFrame:
        """A frame as it is stored. Raises ValueError for a file that cannot be read."""


CACHE_BYTES = 512 * 2**20


def pixel_cache(limit: int = CACHE_BYTES) -> BoundedCache[np.ndarray]:
    """A cache of decoded images, for the scenes of one source to share; limit in bytes."""
    return BoundedCache(limit, _bytes)


def _bytes(pixels: np.ndarray) -> int:
    return pixels.nbytes


@dataclass(frozen=True)
class Development:
    """How photos are brought to their delivered form.

    image_size: (H, W). background: RGB in [0, 1] behind transparent pixels. depth_unit: world units
    per number of a depth map.
    """

    image_size: Size
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    depth_unit: float = 1e-3


class PhotoScene(EncodedScene):
    """The photos of one listing, in its order. World: that of the listing's poses.

    held_out: frames that training never sees. cache: shared by the scenes of a source; an own one
    by default.
    """

    def __init__(
        self,
        name: str,
        frames: Sequence[PhotoFrame],
        development: Development,
        held_out: Sequence[int] = (),
        cache: BoundedCache[np.ndarray] | None = None,
    ) -> None:
        self.name, self.held_out = name, tuple(held_out)
        self._frames, self._development = frames, development
        self._cache = cache or pixel_cache()

    def __len__(self) -> int:
        return len(self._frames)

    @cached_property
    def cameras(self) -> Cameras:  # pyright: ignore[reportIncompatibleVariableOverride]
        """See `Scene`; float64. Raises ValueError where a photo and its listed size disagree."""
        target = self._development.image_size
        intrinsics = [
            CropResize(size, target).intrinsics(
                torch.tensor(frame.at_size(size), dtype=torch.float64)
            )
            for frame, size in zip(self._frames, self._sizes(), strict=True)
        ]
        c2w = torch.from_numpy(np.stack([frame.c2w for frame in self._frames]))
        return Cameras(c2w, torch.stack(intrinsics), target)

    def _sizes(self) -> list[Size]:
        """(H, W) of every photo. One stands for those of its folder that are listed alike."""
        known: dict[object, Size] = {}
        sizes: list[Size] = []
        for frame in self._frames:
            alike = (frame.path.parent, frame.size) if frame.size else frame.path
            if alike not in known:
                known[alike] = _agreed(frame, image_size(frame.path))
            sizes.append(known[alike])
        return sizes

    def images(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`. Raises ValueError for a file that cannot be decoded."""
        return to_tensor(np.stack([self._kept("image", self._image, i) for i in frames]))

    def masks(self, frames: Sequence[int]) -> Tensor | None:
        """See `Scene`; 1 everywhere for a photo without a mask in a scene that has some."""
        if all(frame.mask is None for frame in self._frames):
            return None
        masks = np.stack([self._kept("mask", self._mask, i) for i in frames])
        return torch.from_numpy(masks)[:, None].float().div_(255)

    def depths(self, frames: Sequence[int]) -> Tensor | None:
        """See `Scene`; 0 where a map says nothing. None unless all `frames` have a map."""
        if any(self._frames[i].depth is None for i in frames):
            return None
        return torch.from_numpy(np.stack([self._kept("depth", self._depth, i) for i in frames]))[
            :, None
        ]

    def frame_name(self, frame: int) -> str:
        """See `Scene`: the image file, relative to the scene's folder."""
        return self._frames[frame].name

    def encoded(self, frame: int) -> EncodedFrame:
        """See `EncodedScene`."""
        listed = self._frames[frame]
        size = _agreed(listed, image_size(listed.path))
        return EncodedFrame(
            self.frame_name(frame), listed.path.read_bytes(), listed.c2w, listed.at_size(size),
            size, listed.lens, None if listed.mask is None else _png(_full_mask(listed)),
            self._development.background,
        )  # fmt: skip

    def _kept(self, kind: str, make: Callable[[PhotoFrame], np.ndarray], index: int) -> np.ndarray:
        return self._cache.get((self.name, kind, index), lambda: make(self._frames[index]))

    def _image(self, frame: PhotoFrame) -> np.ndarray:
        pixels = np.array(open_rgb(frame.path, self._development.background))
        _agreed(frame, pixels.shape[:2])
        return self._resized(_pinhole(frame, pixels))

    def _mask(self, frame: PhotoFrame) -> np.ndarray:
        if frame.mask is None:
            return np.full(self._development.image_size, 255, np.uint8)
        mask = _full_mask(frame)
        _agreed(frame, mask.shape, frame.mask)
        return self._resized(_pinhole(frame, mask))

    def _depth(self, frame: PhotoFrame) -> np.ndarray:
        assert frame.depth is not None
        depth = open_depth(frame.depth, self._development.depth_unit)
        _agreed(frame, depth.shape, frame.depth)
        if frame.lens is not None:
            depth = undistorted(depth, frame.at_size(depth.shape), frame.lens, "nearest")
        return nearest(depth, CropResize(depth.shape, self._development.image_size))

    def _resized(self, pixels: np.ndarray) -> np.ndarray:
        crop = CropResize(pixels.shape[:2], self._development.image_size)
        return crop.image(Image.fromarray(pixels))


def _pinhole(frame: PhotoFrame, pixels: np.ndarray) -> np.ndarray:
    if frame.lens is None:
        return pixels
    return undistorted(pixels, frame.at_size(pixels.shape[:2]), frame.lens)


def _full_mask(frame: PhotoFrame) -> np.ndarray:
    assert frame.mask is not None
    return alpha_mask(frame.path) if frame.mask == frame.path else open_mask(frame.mask)


def _agreed(frame: PhotoFrame, size: tuple[int, ...], file: UPath | None = None) -> Size:
    """`size` of a file of the frame, its photo by default, if it goes with what is listed."""
    height, width = size
    for fault in size_faults((height, width), frame.size):
        raise ValueError(f"{file or frame.path}: {fault}")
    return height, width


def _png(mask: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(mask).save(buffer, "png")
    return buffer.getvalue()

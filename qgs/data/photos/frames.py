"""A photo as a listing gives it: pose, intrinsics, lens, files; and checks of these."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor
from upath import UPath

from qgs.data.images import CropResize
from qgs.data.lazy import warn_once
from qgs.data.lenses import Lens
from qgs.geometry.rays import pixel_directions

Intrinsics: TypeAlias = tuple[float, float, float, float]
Size: TypeAlias = tuple[int, int]


@dataclass(frozen=True)
class Fault:
    """Something wrong with a frame, and what to do; readers refuse frames with fatal ones."""

    reason: str
    fix: str
    fatal: bool = True

    def __str__(self) -> str:
        return f"{self.reason}: {self.fix}"


@dataclass(frozen=True)
class PhotoFrame:
    """One photo as listed; nothing of it is judged yet (see `qgs.data.photos.frames`).

    name: the image file relative to the scene's folder. path: that file; mask, depth: those that go
    with it. A mask that is the image itself is its alpha channel. c2w: (4, 4) float64 OpenCV
    camera-to-world. intrinsics: fx, fy, cx, cy in pixels of an image of `size` (H, W), or of the
    file where the listing gives no size. lens: None for a pinhole. split: what the listing uses it
    for; None where it says nothing. faults: what the listing says that cannot be read; a pose or
    intrinsics concerned are NaN.
    """

    name: str
    path: UPath
    c2w: np.ndarray
    intrinsics: Intrinsics
    size: Size | None = None
    lens: Lens | None = None
    mask: UPath | None = None
    depth: UPath | None = None
    split: Literal["train", "test", "unused"] | None = None
    faults: tuple[Fault, ...] = ()

    def at_size(self, size: Size) -> Intrinsics:
        """Intrinsics in pixels of an image file of `size`, a scaled copy of what is listed."""
        height, width = self.size or size
        x, y = size[1] / width, size[0] / height
        fx, fy, cx, cy = self.intrinsics
        return fx * x, fy * y, cx * x, cy * y


def undistorted(
    pixels: np.ndarray,
    intrinsics: Intrinsics,
    lens: Lens,
    mode: Literal["bilinear", "nearest"] = "bilinear",
) -> np.ndarray:
    """The photo as a pinhole camera with the same intrinsics would have taken it.

    pixels: (H, W) or (H, W, C), returned in the same shape and dtype. intrinsics: in pixels of it.
    What the lens did not see is 0.
    """
    height, width = pixels.shape[:2]
    grid, seen = _source_grid(intrinsics, lens, (height, width))
    planes = torch.from_numpy(pixels.reshape(height, width, -1)).permute(2, 0, 1).float()
    flat = F.grid_sample(
        planes[None], grid[None], mode=mode, padding_mode="border", align_corners=False
    )[0]
    flat = flat * seen
    result = flat.permute(1, 2, 0).numpy().reshape(pixels.shape)
    if np.issubdtype(pixels.dtype, np.integer):
        result = result.round()
    return result.astype(pixels.dtype)


def _source_grid(
    intrinsics: Intrinsics, lens: Lens, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Where in the photo each pinhole pixel is to be found, and whether it is there.

    (H, W, 2), from -1 to 1 across the photo, and (H, W).
    """
    camera = torch.tensor(intrinsics)
    focal, centre = camera.split(2)
    directions = pixel_directions(camera, size)[..., :2]
    source = focal * lens.distorted(directions) + centre
    grid = source / torch.tensor(size[::-1]) * 2 - 1
    return grid, lens.sees(directions) & (grid.abs() <= 1).all(-1)


_RIGID = 1e-3  # of rotations against orthonormality
_SAME_ASPECT = 0.01  # relative difference between the file's and the listing's aspect ratio
_SQUARE = 0.1  # relative difference of sides, or of fx and fy, that is none
_NORMALISED = 5.0  # a focal length below is in units of the image, not of its pixels
_FOCAL = (0.1, 30.0)  # of the longer side: angles of view of 157 and 2 degrees


def pose_faults(c2w: np.ndarray) -> Iterator[Fault]:
    """What is wrong with a pose (4, 4): NaN, mirrored, sheared or scaled."""
    if not np.isfinite(c2w).all():
        yield Fault("the pose has NaN or infinite numbers", "remove the frame")
        return
    rotation = c2w[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    determinant = float(np.linalg.det(rotation))
    if error <= _RIGID and determinant < 0:
        yield Fault(
            f"the pose mirrors and so is not rigid (determinant {determinant:.3g})",
            "negate one axis of the camera, or export the poses again",
        )
    elif error > _RIGID or np.abs(c2w[3] - [0, 0, 0, 1]).max() > _RIGID:
        yield Fault(
            f"the pose is not rigid (rotation off by {error:.2g}, determinant {determinant:.3g}, "
            f"last row {c2w[3].tolist()})",
            "poses must rotate and translate only; divide the rotation by its scale",
        )


def intrinsics_faults(intrinsics: Intrinsics, size: Size | None) -> Iterator[Fault]:
    """What is wrong with fx, fy, cx, cy in pixels of an image of `size` (H, W), where it is known.

    Fatal where they cannot be pixels at all; a principal point off the image and a strange angle
    of view may be right, and are told only.
    """
    fx, fy, cx, cy = intrinsics
    said = f"fx {fx:.6g}, fy {fy:.6g}, cx {cx:.6g}, cy {cy:.6g}"
    if not all(map(math.isfinite, intrinsics)) or fx <= 0 or fy <= 0:
        fix = "focal lengths must be positive; export the intrinsics again"
        yield Fault(f"intrinsics are no numbers of a camera ({said})", fix)
        return
    in_pixels = size is not None and max(size) > 20 * _NORMALISED
    if max(fx, fy) < _NORMALISED and (in_pixels or max(abs(cx), abs(cy)) <= 1):
        yield Fault(
            f"the intrinsics look normalised ({said})",
            "they must be in pixels; multiply fx and cx by the width, fy and cy by the height",
        )
        return
    if size is None:
        return
    height, width = size
    if not (0 < cx < width and 0 < cy < height):
        yield Fault(
            f"the principal point lies off the image ({said}, {width} x {height} pixels)",
            "correct cx and cy, unless the photo is cut from a larger one",
            fatal=False,
        )
    focal = [f / max(size) for f in (fx, fy)]
    if _divided_by_wrong_side(fx / fy, width / height):
        yield Fault(
            f"fx and fy differ as if divided by the wrong side of the image ({said}, {width} x "
            f"{height} pixels)",
            "width and height are swapped; divide fx and cx by the width, fy and cy by the height",
            fatal=False,
        )
    elif min(focal) < _FOCAL[0] or max(focal) > _FOCAL[1] or not 0.5 < fx / fy < 2:
        yield Fault(
            f"the focal lengths are implausible ({said}, {width} x {height} pixels)",
            "correct them, or the size that goes with them",
            fatal=False,
        )


def _divided_by_wrong_side(ratio: float, aspect: float) -> bool:
    """Whether fx / fy is what square pixels give when width and height have been swapped."""
    return abs(aspect - 1) > _SQUARE and abs(ratio / aspect**2 - 1) < _SQUARE


def size_faults(size: Size, listed: Size | None) -> Iterator[Fault]:
    """What is wrong with an image file of `size` (H, W) listed with another one.

    A scaled copy is right: intrinsics follow its size.
    """
    if listed is None:
        return
    ratio = size[1] * listed[0] / (size[0] * listed[1])
    if abs(ratio - 1) <= _SAME_ASPECT:
        return
    swapped = abs(size[1] * listed[1] / (size[0] * listed[0]) - 1) <= _SAME_ASPECT
    yield Fault(
        f"the image is {size[1]} x {size[0]} pixels, but listed as {listed[1]} x {listed[0]}, "
        "another aspect ratio, so that the intrinsics cannot be scaled",
        "width and height are swapped; swap them back" if swapped
        else "give the original image, or correct the listed size",
    )  # fmt: skip


def frame_faults(frame: PhotoFrame) -> Iterator[Fault]:
    """Everything that is wrong with `frame` as listed, without opening its image."""
    yield from frame.faults
    if not frame.faults:
        yield from pose_faults(frame.c2w)
        yield from intrinsics_faults(frame.intrinsics, frame.size)


def require_sound(listing: object, frames: Sequence[PhotoFrame]) -> None:
    """Raise ValueError for the first frame of `listing` that has a fatal fault, naming both.

    Of other faults, the first is logged, with the number of frames that have any.
    """
    doubtful: list[str] = []
    for index, frame in enumerate(frames):
        faults = list(frame_faults(frame))
        name = f" ({frame.name})" if frame.name else ""
        for fault in faults:
            if fault.fatal:
                raise ValueError(f"{listing}: frame {index}{name}: {fault}")
        doubtful += [f"frame {index}{name}: {faults[0]}"] if faults else []
    if doubtful:
        warn_once(
            f"{listing}: {len(doubtful)} of {len(frames)} frames are doubtful, first {doubtful[0]}"
        )


_ERRORS = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)


def image_size(path: UPath) -> Size:
    """(H, W) of an image file, of which only the header is read.

    Raises ValueError for a file that is no image.
    """
    try:
        with path.open("rb") as file, Image.open(file) as image:
            return image.height, image.width
    except _ERRORS as error:
        raise ValueError(
            f"{path} cannot be read as an image ({error}): replace the file, or remove its frame"
        ) from error


def open_mask(path: UPath) -> np.ndarray:
    """A mask file as (H, W) uint8, 255 where the photo shows what is to be modelled.

    Files of zeros and ones are read as such. Raises ValueError for a file that is no image.
    """
    grey = np.array(_opened(path, "mask").convert("L"))
    return grey * np.uint8(255) if grey.max() == 1 else grey


def alpha_mask(path: UPath) -> np.ndarray:
    """The alpha channel of a photo as (H, W) uint8; 255 for one without. Raises as `open_mask`."""
    image = _opened(path, "image")
    if not image.has_transparency_data:
        return np.full((image.height, image.width), 255, np.uint8)
    return np.array(image.convert("RGBA").getchannel("A"))


def open_depth(path: UPath, unit: float) -> np.ndarray:
    """A depth map, an image of integers or a .npy file, as (H, W) float32 of world units.

    unit: world units per number of the file. What is not finite becomes 0, for unknown.
    Raises ValueError for another kind of file.
    """
    if path.suffix.lower() == ".npy":
        try:
            with path.open("rb") as file:
                depth = np.load(file, allow_pickle=False)
        except _ERRORS as error:
            raise ValueError(f"{path} cannot be read as a depth map ({error})") from error
        depth = depth.squeeze() if isinstance(depth, np.ndarray) else np.zeros(0)
    else:
        depth = np.array(_opened(path, "depth map"))
    if depth.ndim != 2 or depth.dtype.kind not in "fiu":
        raise ValueError(
            f"{path} must hold one number for each pixel, got {depth.dtype} {depth.shape}: give "
            "16-bit images or .npy files, or remove 'depth_file_path'"
        )
    metric = (depth * unit).astype(np.float32)
    return np.where(np.isfinite(metric), metric, np.float32(0))


def nearest(values: np.ndarray, crop: CropResize) -> np.ndarray:
    """Numbers (H, W) float32 of the source's size at the target's pixels, none of them mixed."""
    height, width = crop.target
    left, top, right, bottom = crop.box
    box = (left, top, min(right, crop.source[1]), min(bottom, crop.source[0]))
    image = Image.fromarray(values)
    return np.array(image.resize((width, height), Image.Resampling.NEAREST, box=box))


def _opened(path: UPath, kind: str) -> Image.Image:
    try:
        with path.open("rb") as file, Image.open(file) as image:
            image.load()
            return image
    except _ERRORS as error:
        raise ValueError(
            f"{path} cannot be read as the {kind} of a photo ({error}): replace the file, or "
            "remove it from its frame"
        ) from error

"""Base class of photo readers, the frames that they return, and checks of frames."""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

import numpy as np
import torch
from upath import UPath

from qgs.extensions import ExtensionError, installed, load
from qgs.paths import listing
from qgs.types import Size
from qgs.wording import listed, numbered, warn_once

Intrinsics = tuple[float, float, float, float]
GROUP = "qgs.photo_readers"
"""Entry-point group in which plug-ins list their subclasses of `PhotoReader` by format name."""
UNLESS = (
    "correct the intrinsics, unless the photo is cut from a larger one; fx and cx refer to the "
    "width, fy and cy to the height"
)
_COPY = re.compile(r"images(_\d+)?")
# Pixels of a listed photo.
LARGEST_SIDE = 10**6
# Largest coordinate of a camera: the square of larger ones overflows float32.
_FARTHEST = 1e12
# Tolerance of rotations against orthonormality.
_RIGID = 1e-3
# A camera so many times farther from the middle than three quarters of all has a wrong pose.
_STRAY = 100
# Relative difference between the file's and the listing's aspect ratio.
_SAME_ASPECT = 0.01
# Ratio of fx and fy up to which pixels are about square.
_SQUARE = 1.4
# Of a side, of the principal point from the middle.
_OFF_CENTRE = 0.3
# A focal length below is in units of the image, not of its pixels.
_NORMALISED = 5.0
# Focal lengths per longer side: angles of view of 157 and 2 degrees.
_FOCAL = (0.1, 30.0)


@dataclass(frozen=True)
class FrameProblem:
    """A mistake in the listing of one frame: the reason and how to fix it."""

    reason: str
    fix: str

    def __str__(self) -> str:
        return f"{self.reason}: {self.fix}"


class Lens(ABC):
    """Lens with distortion, made by `PhotoReader.lens`; hashable. Pinhole cameras have no lens."""

    @abstractmethod
    def undistorted(
        self, pixels: np.ndarray, intrinsics: Intrinsics, nearest: bool = False
    ) -> np.ndarray:
        """Return the photo that a pinhole camera with the same intrinsics would have taken.

        pixels: the photo, (H, W) or (H, W, C); the result has its shape and dtype. Pixels outside
            of the photo become 0. intrinsics: fx, fy, cx, cy in pixels of the photo. nearest: take
            the nearest pixel instead of interpolating.
        """

    @abstractmethod
    def whole_zoom(self, intrinsics: Intrinsics, size: Size, target: Size) -> float:
        """Return the least zoom at which a centre crop of the undistorted photo has no black edges.

        The sides of the crop are those of the largest crop with the aspect ratio of `target` (H,
        W), divided by the zoom, which is at least 1. intrinsics: fx, fy, cx, cy in pixels of the
        photo. size: (H, W) of the photo.
        """

    @abstractmethod
    def turned(self) -> Self:
        """Return the lens of this camera after a clockwise turn by 90 degrees."""


@dataclass(frozen=True)
class PhotoFrame:
    """One photo as listed. Its values are checked later, by `sound_frames`.

    name: image file relative to the scene's folder. path: path of the image.
    mask: file of the mask; the image itself if its alpha channel is the mask. depth: file of the
        depth map. Either is None if not listed.
    c2w: (4, 4) float64 OpenCV camera-to-world.
    intrinsics: fx, fy, cx, cy in pixels of an image of `size` (H, W); without a listed size, in
        pixels of the file.
    lens: lens with distortion; None for a pinhole camera.
    split: the listed split; None without splits.
    time: when the photo was taken, in the listing's unit; None for static scenes.
    turns: number of clockwise quarter turns that bring the stored pixels upright, see
        `qgs.data.photos.source.upright`.
    problems: values in the listing that cannot be read; an unreadable pose or unreadable intrinsics
        are NaN.
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
    time: float | None = None
    turns: int = 0
    problems: tuple[FrameProblem, ...] = ()

    def at_size(self, size: Size) -> Intrinsics:
        """Return fx, fy, cx, cy in pixels of a scaled copy of the photo, of size (H, W)."""
        height, width = self.size or size
        x = size[1] / width
        y = size[0] / height
        fx, fy, cx, cy = self.intrinsics
        return fx * x, fy * y, cx * x, cy * y


@dataclass(frozen=True)
class Listing:
    """Photos and cameras that a file lists for a folder.

    file: the file with the list. frames: in the order of this file.
    folder: folder of the photos; None if it is the folder that was read.
    present: listed files that exist.
    """

    file: UPath
    frames: Sequence[PhotoFrame]
    folder: UPath | None = None
    present: Collection[UPath] = ()


class PhotoReader(ABC):
    """Base class of photo readers; each reads one format that lists photos and cameras.

    The name of the format is that of the reader's entry point in the group `GROUP`.
    """

    listing: ClassVar[str]
    """Path of the listing file inside the folder of photos."""

    @classmethod
    def recognises(cls, folder: UPath) -> bool:
        """Return whether `folder` holds photos in this format."""
        return (folder / cls.listing).is_file()

    @classmethod
    def posed(cls, path: UPath) -> UPath | None:
        """Compute cameras for a video or for photos; return a folder of photos and cameras.

        An existing result is reused. Returns None if this reader cannot compute cameras. Commands
        that open a user's photos call this method; training never does.
        """
        return None

    @classmethod
    def lens(cls, model: str, coefficients: Mapping[str, float]) -> Lens | None:
        """Return the lens of a camera model; None if this reader does not know the model.

        model: name of the model in nerfstudio or COLMAP. coefficients: nonzero distortion
            coefficients by name, such as k1.
        """
        return None

    @classmethod
    @abstractmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """Read the photos and cameras that `folder` lists.

        Consecutive frames of the result should be near in space. images: folder with scaled copies
        of the photos to read, such as images_4; None reads the listed photos. Raises
        FileNotFoundError if this folder does not exist, and ValueError for an unreadable listing.
        """


def installed_readers() -> dict[str, type[PhotoReader]]:
    """Return the readers of installed plug-ins by format name.

    If two readers have the same name, the first counts. A reader that cannot be loaded is left out
    with a warning.
    """
    found: dict[str, type[PhotoReader]] = {}
    for entry in installed(GROUP):
        # A broken distribution must not hinder folders of other formats.
        try:
            found.setdefault(entry.name, load(entry, PhotoReader))
        except ExtensionError as error:
            warn_once(str(error))
    return found


def numbers(value: object) -> np.ndarray:
    """Return nested lists of numbers as a float64 array; an empty array for any other value."""
    try:
        return np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)


def image_folder(folder: UPath, wanted: str | None) -> UPath:
    """Return the folder of a scene's photos: `wanted` in `folder`, or a default one if it is None.

    The default is the first of these that exists: the subfolder images, the subfolder with the
    largest scaled copies, such as images_2, and `folder`. Raises FileNotFoundError if `wanted` is
    given and does not exist.
    """
    if wanted is None:
        copies = [item for item in listing(folder) if _COPY.fullmatch(item.name.lower())]
        # images comes before images_2, and images_16 last.
        return min(
            filter(UPath.is_dir, copies),
            key=lambda item: (len(item.name), item.name),
            default=folder,
        )
    if not (folder / wanted).is_dir():
        raise FileNotFoundError(f"{folder / wanted} does not exist: correct the option `images`")
    return folder / wanted


def mended(found: Listing) -> Listing:
    """Divide rotations by their uniform scale; add a problem to frames with a far-off camera.

    The scale comes from Metashape, which multiplies all rotations of a file by one number.
    """
    if not found.frames:
        return found
    poses = torch.from_numpy(np.stack([frame.c2w for frame in found.frames]))
    scales = torch.linalg.det(poses[:, :3, :3]).abs() ** (1 / 3)
    # A shear and NaN stay as they are, and are refused.
    scaled = ((scales - 1).abs() > _RIGID) & (scales > 0)
    poses[scaled, :, :3] /= scales[scaled, None, None]
    if scaled.any():
        warn_once(f"{found.file}: a scale is divided out of the rotations of {scaled.sum()} frames")
    distances = (poses[:, :3, 3] - poses[:, :3, 3].nanmedian(0).values).norm(dim=-1)
    # The lower of two: of three or four cameras, the far one is no measure.
    usual = distances.nanquantile(0.75, interpolation="lower")
    far = (distances > _STRAY * usual) & (usual > 0)
    stray = FrameProblem(
        f"the camera stands more than {_STRAY} times as far away as most other cameras",
        "correct its pose, or remove the frame",
    )
    frames = [
        replace(frame, c2w=pose, problems=frame.problems + (stray,) * is_far)
        for frame, pose, is_far in zip(found.frames, poses.numpy(), far.tolist(), strict=True)
    ]
    return replace(found, frames=frames)


def pose_problems(c2w: np.ndarray) -> Iterator[FrameProblem]:
    """Yield a problem if a pose (4, 4) has NaN or huge values, or is not rigid."""
    # NaN is not at most anything.
    if not np.abs(c2w).max() <= _FARTHEST:
        reason = f"the pose has NaN or numbers larger than {_FARTHEST:.0e}"
        yield FrameProblem(reason, "correct the pose, or remove the frame")
        return
    # Mirrored is told from sheared: the remedies differ.
    rotation = c2w[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > _RIGID or np.abs(c2w[3] - [0, 0, 0, 1]).max() > _RIGID:
        yield FrameProblem(
            f"the pose is not rigid (rotation off by {error:.2g}, last row {c2w[3].tolist()})",
            "poses must rotate and translate only; divide the rotation by its scale",
        )
    elif np.linalg.det(rotation) < 0:
        fix = "negate one axis of the camera, or export the poses again"
        yield FrameProblem("the pose is mirrored, so it is not rigid", fix)


def intrinsics_problems(intrinsics: Intrinsics, size: Size | None) -> Iterator[FrameProblem]:
    """Yield a problem if intrinsics are not finite or not in pixels, or a focal length is <= 0.

    size: listed image size (H, W); None if none is listed.
    """
    fx, fy, cx, cy = intrinsics
    values = f"(fx {fx:.6g}, fy {fy:.6g}, cx {cx:.6g}, cy {cy:.6g})"
    if not all(map(math.isfinite, intrinsics)) or fx <= 0 or fy <= 0:
        reason = f"intrinsics must be finite and focal lengths positive {values}"
        yield FrameProblem(reason, "export the intrinsics again")
        return
    in_pixels = size is not None and max(size) > 20 * _NORMALISED
    if max(fx, fy) < _NORMALISED and (in_pixels or max(abs(cx), abs(cy)) <= 1):
        fix = "write pixels: multiply fx and cx by the width, fy and cy by the height"
        yield FrameProblem(f"the intrinsics look normalised {values}", fix)


def are_plausible(intrinsics: Intrinsics, size: Size) -> bool:
    """Return whether fx, fy, cx, cy are usual for an uncropped photo of `size` (H, W)."""
    fx, fy, cx, cy = intrinsics
    height, width = size
    nearest, farthest = (limit * max(size) for limit in _FOCAL)
    off_centre = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
    usual = nearest <= min(fx, fy) and max(fx, fy) <= farthest and off_centre <= _OFF_CENTRE
    return usual and 1 / _SQUARE < fx / fy < _SQUARE


def size_problems(size: Size, listed: Size | None) -> Iterator[FrameProblem]:
    """Yield a problem if an image's `size` (H, W) and `listed` size differ in aspect ratio.

    If `listed` is None, there is no problem.
    """
    if listed is None or _alike(size, listed):
        return
    swapped = _alike(size, (listed[1], listed[0]))
    yield FrameProblem(
        f"the image is {size[1]} x {size[0]} pixels, but listed as {listed[1]} x {listed[0]}, "
        "another aspect ratio, so the intrinsics cannot be scaled",
        "width and height are swapped; swap the listed ones, or turn the stored pixels as EXIF "
        "says (`mogrify -auto-orient`)"
        if swapped
        else "restore the original image, or correct the listed size",
    )


def _alike(size: Size, other: Size) -> bool:
    """Return whether two sizes have about the same aspect ratio."""
    return abs(size[1] * other[0] / (size[0] * other[1]) - 1) <= _SAME_ASPECT


def listed_size(height: float, width: float) -> tuple[Size | None, tuple[FrameProblem, ...]]:
    """Return a listed size as (H, W) and no problem, or None and a problem if it is impossible."""
    if all(1 <= side <= LARGEST_SIDE for side in (height, width)):
        return (round(height), round(width)), ()
    size = f"{str(width)[:12]} x {str(height)[:12]}"
    reason = f"the listed size, {size} pixels, is impossible for a photo"
    return None, (FrameProblem(reason, "correct the width and height"),)


def sound_frames(listing: object, frames: Sequence[PhotoFrame]) -> list[PhotoFrame]:
    """Return the frames without problems; warn of other frames and of implausible intrinsics.

    listing: file to name in messages. Raises ValueError if fewer than two frames are left.
    """
    sound: list[PhotoFrame] = []
    faulty: list[str] = []
    for index, frame in enumerate(frames):
        problems = frame.problems or (
            *pose_problems(frame.c2w),
            *intrinsics_problems(frame.intrinsics, frame.size),
        )
        if problems:
            faulty.append(f"frame {numbered(index, frame.name)}: {problems[0]}")
        else:
            sound.append(frame)
    if faulty and len(sound) < 2:
        raise ValueError(f"{listing}: {faulty[0]}")
    if faulty:
        warn_once(
            f"{listing}: {len(faulty)} of {len(frames)} frames are left out: "
            f"{listed(faulty, 3, '; ')}"
        )
    doubtful = [f.name for f in sound if f.size and not are_plausible(f.intrinsics, f.size)]
    if doubtful:
        warn_once(
            f"{listing}: {len(doubtful)} of {len(frames)} frames have intrinsics that are "
            f"implausible for the size: {listed(doubtful, 3)}; {UNLESS}"
        )
    return sound

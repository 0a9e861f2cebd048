"""Decode the photos of scenes that are checked."""

import hashlib
import io
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from PIL import Image

from qgs.data.images import decode_rgb, eight_bits, opened_image, orientation
from qgs.data.photos.reader import FrameProblem, PhotoFrame, Size, size_problems
from qgs.data.photos.source import turned, turned_size
from qgs.wording import one_line
from qgs_photos.datatools.findings import Finding, Severity

_ERRORS = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)
# Asks JPEG for its coarsest picture: all bytes are read, few pixels are made.
_SMALLEST = (8, 8)
# Of 255: a covered lens has noise.
_BLACK = 4
_REPLACE = "replace it, or remove its frame"
# Size at which the edges of photos and masks are compared.
_SQUARE = (64, 64)


@dataclass(frozen=True)
class Photo:
    """A photo to check.

    listed: entry of the photo in the data set: name, camera, size. read: returns the bytes of the
    photo's file. maps: functions by name that return the mask and the depth map of the photo,
    (H, W), or None if it has no such map. exists: whether the photo's file exists.
    """

    listed: PhotoFrame
    read: Callable[[], bytes]
    maps: Mapping[str, Callable[[], np.ndarray | None]]
    exists: bool = True

    def picture(self, size: Size | None, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the undistorted photo, (H, W, 3) uint8, and its intrinsics fx, fy, cx, cy.

        size: (H, W) of the file, used if the data set lists no size. side: largest length of the
        result's longer side in pixels. Raises OSError if the file cannot be read.
        """
        frame = self.listed if self.listed.size else replace(self.listed, size=size)
        image = turned(decode_rgb(io.BytesIO(self.read())), frame)
        scale = min(1.0, side / max(image.size))
        width, height = (max(1, round(extent * scale)) for extent in image.size)
        pixels = np.array(image.resize((width, height), Image.Resampling.LANCZOS))
        intrinsics = frame.at_size((height, width))
        if frame.lens is not None:
            pixels = frame.lens.undistorted(pixels, intrinsics)
        return pixels, np.array(intrinsics)


Photos = tuple[Sequence[Photo], Sequence[str]]
"""Photos of a scene, and names of listed images that do not exist and are not among them."""


@dataclass(frozen=True)
class Candidate:
    """A scene to check, whose photos are listed only when its turn comes.

    kind: format of the scene. photos: function that lists the photos; it raises ValueError or
    OSError for an unreadable scene.
    """

    name: str
    kind: str
    photos: Callable[[], Photos]
    split: str = ""


@dataclass(frozen=True)
class Decoded:
    """Result of decoding a photo.

    size: (H, W); None if it cannot be decoded. digest: hash of the file's bytes, by which equal
    photos are found. errors: what is wrong with the files. unturned: whether the photo has an EXIF
    orientation that is ignored. empty_mask: whether the mask leaves out the whole photo; None
    without a mask. edges: strength of edges in the photo and in its mask, two maps of size _SQUARE;
    None without a mask.
    """

    size: Size | None = None
    digest: bytes = b""
    errors: Sequence[FrameProblem] = ()
    unturned: bool = False
    empty_mask: bool | None = None
    edges: np.ndarray | None = None


@dataclass(frozen=True)
class DecodedScene:
    """The photos of a scene, each with the result of decoding it."""

    name: str
    photos: Sequence[Photo]
    decoded: Sequence[Decoded]

    def finding(
        self, frames: Sequence[int], reason: str, fix: str, severity: Severity = "error"
    ) -> Finding:
        """Return a finding about some photos. frames: their indices in `photos`."""
        photos = [(frame, self.photos[frame].listed.name, self.numbers[frame]) for frame in frames]
        return Finding(self.name, reason, fix, severity, tuple(photos))

    @cached_property
    def numbers(self) -> Sequence[int | None]:
        """Frame number of each photo in the loaded scene; None for photos that are left out."""
        count = itertools.count()
        return [
            next(count) if photo.exists and photo.listed.split != "unused" else None
            for photo in self.photos
        ]


def decode(photo: Photo, headers_only: bool) -> Decoded:
    """Decode a photo, its mask and its depth map, and report what fails.

    headers_only: read only the header of the photo, and neither its mask nor its depth map.
    """
    if not photo.listed.name:
        return Decoded()
    if not photo.exists:
        missing = FrameProblem("the image does not exist", "add it, or remove its frame")
        return Decoded(errors=[missing])
    try:
        data = photo.read()
        digest = hashlib.blake2b(data, digest_size=16).digest()
        with opened_image(io.BytesIO(data)) as image:
            size = turned_size((image.height, image.width), photo.listed)
            if headers_only:
                return Decoded(size=size, digest=digest)
            image.draft(None, _SMALLEST)
            image.load()
            pixels = eight_bits(image)
            rgba = np.array(pixels.resize((96, 96)).convert("RGBA"))
            black = rgba[..., :3].max() <= _BLACK and rgba[..., 3].min() == 255
            # EXIF may stand behind the pixels
            unturned = orientation(image) != 1 and not photo.listed.turns
    except Exception as error:
        # whatever a reader raises; the other photos go on
        reason = f"the image cannot be decoded ({error_text(error)})"
        return Decoded(errors=[FrameProblem(reason, _REPLACE)])
    errors = [FrameProblem("the image is black", _REPLACE)] if black else []
    empty: bool | None = None
    edges: np.ndarray | None = None
    for kind, read in photo.maps.items():
        try:
            found = read()
            if found is None:
                continue
            own = turned_size(found.shape[:2], photo.listed)
            reasons = [f"the {kind}: {problem.reason}" for problem in size_problems(own, size)]
            if kind == "mask":
                empty = not found.any()
                kept = Image.fromarray(found > found.max() / 2)
                edges = np.stack([_edges(pixels.convert("L")), _edges(kept)])
        except Exception as error:
            reasons = [error_text(error)]
        errors += [FrameProblem(reason, f"replace the {kind}") for reason in reasons]
    return Decoded(size, digest, errors, unturned, empty, edges)


def _edges(image: Image.Image) -> np.ndarray:
    """Return the lengths of the gradients of an image, after it is resized to _SQUARE."""
    x, y = np.gradient(np.array(image.resize(_SQUARE), np.float32))
    return np.hypot(x, y).flatten()


def error_text(error: Exception) -> str:
    """Return the message of a failed reading of a file; for other errors, also their type."""
    return str(error) if isinstance(error, _ERRORS) and str(error) else one_line(error)

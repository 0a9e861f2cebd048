"""Whether photos can be decoded, and have the size that their listing says."""

import hashlib
import io
import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from statistics import median, median_low

import numpy as np
from PIL import Image
from upath import UPath

from qgs.data.images import (
    TURN,
    TURNED,
    alpha_mask,
    eight_bits,
    open_depth,
    open_mask,
    opened_image,
    orientation,
)
from qgs.data.lenses import Size
from qgs.data.photos.checks import size_problems
from qgs.data.photos.reader import PhotoFrame
from qgs.data.photos.turning import turned, turned_size
from qgs.wording import numbered, one_line
from qgs_photos.datatools.candidates import Photo
from qgs_photos.datatools.findings import Finding, Severity

_ERRORS = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)
_SMALLEST = (8, 8)  # asks JPEG for its coarsest picture: all bytes are read, few pixels are made
_SMALL = 96  # pixels of the longer side: shows the outline of a mask
_BLACK = 4  # of 255: a covered lens has noise
_ROUNDING = 1.5  # pixels by which a scaled copy's sides may be off
_CENTRED = 0.1  # of a side: how far from the middle a principal point usually lies at most
_COPY = re.compile(r"images_\d+")


@dataclass(frozen=True)
class Decoded:
    """size: (H, W), None where it cannot be decoded. digest: of the bytes. turned: by EXIF.

    error: text on the photo; other_errors: texts on its mask and depth map, each with a remedy.
    black: whether nothing is to be seen. mask: scaled down to _SMALL pixels, (H, W) in [0, 1].
    """

    size: Size | None = None
    digest: bytes = b""
    turned: bool = False
    error: str | None = None
    other_errors: tuple[tuple[str, str], ...] = ()
    black: bool = False
    mask: np.ndarray | None = None


@dataclass(frozen=True)
class DecodedScene:
    """The photos of a scene, and what decoding each of them gave."""

    name: str
    photos: Sequence[Photo]
    decoded: Sequence[Decoded]

    def finding(
        self, frames: Sequence[int], reason: str, fix: str, severity: Severity = "error"
    ) -> Finding:
        """A finding about some of the frames."""
        names = tuple(self.photos[frame].listed.name for frame in frames)
        numbers = tuple(self.numbers[frame] for frame in frames)
        return Finding(self.name, reason, fix, tuple(frames), names, severity, numbers)

    @cached_property
    def numbers(self) -> Sequence[int | None]:
        """The number that readers give each photo; None for those that they leave out.

        One without a name is refused, not left out.
        """
        count = itertools.count()
        return [
            next(count) if (p.exists or not p.listed.name) and p.listed.split != "unused" else None
            for p in self.photos
        ]

    def label(self, frame: int) -> str:
        """What messages call a photo: its number and name, or its name alone."""
        name, number = self.photos[frame].listed.name, self.numbers[frame]
        return name if number is None else f"frame {numbered(number, name)}"


def decode(photo: Photo, headers_only: bool) -> Decoded:
    """Try a photo, or its header alone."""
    if not photo.exists or not photo.listed.name:
        return Decoded()
    try:
        data = photo.read()
        with opened_image(io.BytesIO(data)) as image:
            size, by_exif = turned_size((image.height, image.width), photo.listed), False
            black = False
            if not headers_only:
                image.draft(None, _SMALLEST)
                image.load()
                black = _is_black(eight_bits(image))
                # EXIF may stand behind the pixels
                by_exif = orientation(image) != 1 and not photo.listed.turns
    except Exception as error:  # whatever a reader raises; the other photos go on
        return Decoded(error=error_text(error))
    digest = hashlib.blake2b(data, digest_size=16).digest()
    if headers_only:
        return Decoded(size, digest, by_exif)
    errors, mask = _others(photo, size)
    return Decoded(size, digest, by_exif, None, errors, black, mask)


def _is_black(image: Image.Image) -> bool:
    """Whether nothing of it is brighter than _BLACK, or transparent."""
    rgba = np.array(image.resize((_SMALL, _SMALL)).convert("RGBA"))
    return bool(rgba[..., :3].max() <= _BLACK and rgba[..., 3].min() == 255)


def error_text(error: Exception) -> str:
    """The message of an exception; with its type where it is not an error of reading a file."""
    return str(error) if isinstance(error, _ERRORS) and str(error) else one_line(error)


def _others(photo: Photo, size: Size) -> tuple[tuple[tuple[str, str], ...], np.ndarray | None]:
    """Faults of mask and depth map of a photo of `size`, with remedies; a sound mask, small."""
    mask, depth = photo.listed.mask, photo.listed.depth
    read_mask = photo.read_mask
    if mask is not None and photo.mask_exists:
        read_mask = partial(_alpha if mask == photo.listed.path else open_mask, mask)
    read_depth = partial(open_depth, depth, 1.0) if depth is not None else None
    errors, sound = list[tuple[str, str]](), dict[str, np.ndarray]()
    for kind, file, read in (("mask", mask, read_mask), ("depth map", depth, read_depth)):
        try:
            found = read() if read else None
            problems = () if found is None else size_problems(found.shape[:2], size)
            reasons = [f"{file or 'its mask'}: {problem.reason}" for problem in problems]
            if found is not None and not reasons:
                sound[kind] = found
        except Exception as error:
            reasons = [error_text(error)]
        errors += [(reason, f"replace the {kind}") for reason in reasons]
    return tuple(errors), _small(sound["mask"], photo.listed) if "mask" in sound else None


def _alpha(path: UPath) -> np.ndarray | None:
    """The alpha channel of a photo, as a mask; None for an opaque one."""
    mask = alpha_mask(path)
    return None if mask.min() == 255 else mask


def _small(mask: np.ndarray, frame: PhotoFrame) -> np.ndarray:
    """As `Decoded.mask`, upright; of uint8, or of a source's numbers in [0, 1]."""
    pixels = mask if mask.dtype == np.uint8 else (255 * mask).astype(np.uint8)
    image = turned(Image.fromarray(pixels), frame)
    scale = min(1.0, _SMALL / max(image.size))
    width, height = (max(1, round(side * scale)) for side in image.size)
    return np.array(image.resize((width, height), Image.Resampling.BOX)) / 255


def file_findings(scene: DecodedScene, listing: str) -> Iterator[Finding]:
    """Missing and damaged files. listing: name of the file that lists the photos."""
    for frame, (photo, result) in enumerate(zip(scene.photos, scene.decoded, strict=True)):
        if photo.listed.name and not photo.exists:
            fix = f"add the file, or remove the frame from {listing}"
            yield scene.finding([frame], "the image does not exist", fix)
        if result.error is not None:
            fix = f"replace the file, or remove the frame from {listing}"
            yield scene.finding([frame], f"the image cannot be decoded ({result.error})", fix)
        if not photo.mask_exists and photo.listed.mask is not None:
            reason = f"its mask does not exist in {photo.listed.mask.parent.name}"
            yield scene.finding([frame], reason, "add it, or list no mask")
        for reason, fix in result.other_errors:
            yield scene.finding([frame], reason, fix)
        if result.turned:
            yield scene.finding([frame], f"photos {TURNED}", TURN, "warning")


@dataclass(frozen=True)
class _Sized:
    """A photo whose size is known, and listed too; sizes are (H, W)."""

    frame: int
    photo: PhotoFrame
    file: Size
    listed: Size

    @property
    def reason(self) -> str:
        return (
            f"the image is {self.file[1]} x {self.file[0]} pixels, but listed as "
            f"{self.listed[1]} x {self.listed[0]}"
        )

    def has_scale(self, scale: float) -> bool:
        return abs(self.file[1] - scale * self.listed[1]) <= _ROUNDING

    @property
    def is_as_listed_or_scaled(self) -> bool:
        """False too where only one of the sides is as listed, which no scale explains."""
        (height, width), (rows, columns) = self.listed, self.file
        scaled = (
            abs(rows - height * columns / width) <= _ROUNDING
            or abs(columns - width * rows / height) <= _ROUNDING
        )
        return self.file == self.listed or (scaled and rows != height and columns != width)

    def off_centre(self, size: Size) -> float:
        """How far the principal point is from the middle of an image of `size`, of a side."""
        _, _, cx, cy = self.photo.intrinsics
        return max(abs(cx / size[1] - 0.5), abs(cy / size[0] - 0.5))


def size_findings(scene: DecodedScene) -> Iterator[Finding]:
    """Photos of another shape than listed, of another scale than the rest, or that shrank unasked.

    Intrinsics follow a scaled copy of the whole scene: it is reported only where its folder is
    not named as one (images_4), and an error where they fit the files and not the listed size.
    """
    rescaled: list[_Sized] = []
    for frame, (photo, result) in enumerate(zip(scene.photos, scene.decoded, strict=True)):
        if result.size is None or photo.listed.size is None:
            continue
        item = _Sized(frame, photo.listed, result.size, photo.listed.size)
        if item.is_as_listed_or_scaled:
            rescaled.append(item)
            continue
        problem = next(size_problems(item.file, item.listed), None)
        fix = "give the original image, or correct the listed size"
        reason, fix = (problem.reason, problem.fix) if problem else (item.reason, fix)
        yield scene.finding([frame], reason, fix)
    if not rescaled:
        return
    usual = median_low(item.file[1] / item.listed[1] for item in rescaled)
    for item in rescaled:
        if not item.has_scale(usual):
            reason = f"{item.reason}, another scale than the rest of the scene"
            yield scene.finding(
                [item.frame], reason, "give the original image, or one scaled as the others"
            )
    if usual == 1:
        return
    scaled = [item for item in rescaled if item.has_scale(usual)]
    fits_files = median(item.off_centre(item.file) for item in scaled) <= _CENTRED
    if fits_files and median(item.off_centre(item.listed) for item in scaled) > _CENTRED:
        severity: Severity = "error"
        fix = "correct the listed width and height, which the intrinsics do not go with"
    elif _COPY.fullmatch(scaled[0].photo.path.parent.name):
        return
    else:
        severity = "warning"
        fix = "nothing if they are a scaled copy: intrinsics are scaled too; else correct the size"
    for item in scaled:
        yield scene.finding([item.frame], item.reason, fix, severity)

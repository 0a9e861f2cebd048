"""Photos of a scene, decoded, with their masks and depth maps."""

import hashlib
import io
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from PIL import Image

from qgs.data.images import (
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
from qgs_photos.datatools.candidates import Photo, shrunk
from qgs_photos.datatools.findings import Finding, Severity

_ERRORS = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)
# Asks JPEG for its coarsest picture: all bytes are read, few pixels are made.
_SMALLEST = (8, 8)
# Pixels of the longer side: shows the outline of a mask.
_SMALL = 96
# Of 255: a covered lens has noise.
_BLACK = 4


@dataclass(frozen=True)
class Decoded:
    """What decoding a photo gave. size: (H, W), None for none. digest: of the bytes.

    turned: by EXIF. error: text on the photo; other_errors: texts on its mask and depth map, each
    with a remedy. black: whether nothing is to be seen. mask: scaled down to _SMALL pixels, (H, W)
    in [0, 1].
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
        """Return a finding about some of the frames."""
        return Finding(
            scene=self.name,
            reason=reason,
            fix=fix,
            frames=tuple(frames),
            names=tuple(self.photos[frame].listed.name for frame in frames),
            severity=severity,
            numbers=tuple(self.numbers[frame] for frame in frames),
        )

    @cached_property
    def numbers(self) -> Sequence[int | None]:
        """The number that readers give each photo; None for those that they leave out."""
        count = itertools.count()
        return [next(count) if _is_read(photo) else None for photo in self.photos]

    def label(self, frame: int) -> str:
        """Return what messages call a photo: its number and name, or its name alone."""
        name = self.photos[frame].listed.name
        number = self.numbers[frame]
        return name if number is None else f"frame {numbered(number, name)}"


def _is_read(photo: Photo) -> bool:
    # a photo without a name is refused, not left out
    return (photo.exists or not photo.listed.name) and photo.listed.split != "unused"


def decode(photo: Photo, headers_only: bool) -> Decoded:
    """Try a photo, or its header alone."""
    if not photo.exists or not photo.listed.name:
        return Decoded()
    try:
        data = photo.read()
        digest = hashlib.blake2b(data, digest_size=16).digest()
        with opened_image(io.BytesIO(data)) as image:
            size = turned_size((image.height, image.width), photo.listed)
            found = Decoded(size=size, digest=digest)
            if headers_only:
                return found
            image.draft(None, _SMALLEST)
            image.load()
            black = _is_black(eight_bits(image))
            # EXIF may stand behind the pixels
            by_exif = orientation(image) != 1 and not photo.listed.turns
    except Exception as error:
        # whatever a reader raises; the other photos go on
        return Decoded(error=error_text(error))
    errors = list[tuple[str, str]]()
    mask = _sound("mask", photo.listed.mask, _mask_reader(photo), size, errors)
    depth = photo.listed.depth
    _sound("depth map", depth, depth and partial(open_depth, depth, 1.0), size, errors)
    return replace(
        found,
        turned=by_exif,
        other_errors=tuple(errors),
        black=black,
        mask=None if mask is None else _small(mask, photo.listed),
    )


def _is_black(image: Image.Image) -> bool:
    """Return whether nothing of it is brighter than _BLACK, or transparent."""
    rgba = np.array(image.resize((_SMALL, _SMALL)).convert("RGBA"))
    return bool(rgba[..., :3].max() <= _BLACK and rgba[..., 3].min() == 255)


def error_text(error: Exception) -> str:
    """Return the message of an exception, with its type unless it is one of reading a file."""
    return str(error) if isinstance(error, _ERRORS) and str(error) else one_line(error)


def _mask_reader(photo: Photo) -> Callable[[], np.ndarray | None] | None:
    mask = photo.listed.mask
    if mask is None or not photo.mask_exists:
        return photo.read_mask
    if mask != photo.listed.path:
        return partial(open_mask, mask)

    def alpha() -> np.ndarray | None:
        channel = alpha_mask(mask)
        # an opaque photo has no mask
        return None if channel.min() == 255 else channel

    return alpha


def _sound(
    kind: str,
    file: object,
    read: Callable[[], np.ndarray | None] | None,
    size: Size,
    errors: list[tuple[str, str]],
) -> np.ndarray | None:
    """Return the map of a photo of `size`; None with an error, and for none."""
    try:
        found = read() if read else None
        problems = () if found is None else size_problems(found.shape[:2], size)
        reasons = [f"{file or 'its mask'}: {problem.reason}" for problem in problems]
    except Exception as error:
        found = None
        reasons = [error_text(error)]
    errors += [(reason, f"replace the {kind}") for reason in reasons]
    return None if reasons else found


def _small(mask: np.ndarray, frame: PhotoFrame) -> np.ndarray:
    """Return `Decoded.mask`, upright; of uint8, or of a source's numbers in [0, 1]."""
    pixels = mask if mask.dtype == np.uint8 else (255 * mask).astype(np.uint8)
    image = turned(Image.fromarray(pixels), frame)
    return np.array(shrunk(image, _SMALL, Image.Resampling.BOX)) / 255

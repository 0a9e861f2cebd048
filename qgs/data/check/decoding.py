"""Whether every photo can be decoded, told by threads that keep nothing of it but its size."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from PIL import Image, UnidentifiedImageError

from qgs.data.check.finding import Finding
from qgs.data.check.photo import Photo
from qgs.data.frames import Size
from qgs.data.photo_files import open_mask

_ERRORS = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)
_SMALLEST = (8, 8)  # asks JPEG for its coarsest picture: all bytes are read, few pixels are made


@dataclass(frozen=True)
class Decoded:
    """size: (H, W); None for a photo that is missing or cannot be decoded. digest: of its bytes.

    error, mask_error: why the photo and its mask cannot be; None where they can or do not exist.
    """

    size: Size | None = None
    digest: bytes = b""
    error: str | None = None
    mask_error: str | None = None


def decode_all(photos: Sequence[Photo], threads: int, headers_only: bool) -> list[Decoded]:
    """Try all photos, or their headers alone."""
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(lambda photo: _decode(photo, headers_only), photos))


def _decode(photo: Photo, headers_only: bool) -> Decoded:
    if not photo.exists or not photo.listed.name:
        return Decoded()
    try:
        data = photo.read()
        with Image.open(io.BytesIO(data)) as image:
            size = (image.height, image.width)
            if not headers_only:
                image.draft(None, _SMALLEST)
                image.load()
    except _ERRORS as error:
        return Decoded(error=_told(error))
    digest = hashlib.blake2b(data, digest_size=16).digest()
    return Decoded(size, digest, mask_error=None if headers_only else _mask_error(photo))


def _told(error: Exception) -> str:
    if isinstance(error, UnidentifiedImageError):
        return "its header is none of a known image format"
    return str(error) or type(error).__name__


def _mask_error(photo: Photo) -> str | None:
    mask = photo.listed.mask
    if mask is None or not photo.mask_exists or mask == photo.listed.path:
        return None
    try:
        open_mask(mask)
    except _ERRORS as error:
        return str(error)
    return None


def file_findings(
    scene: str, photos: Sequence[Photo], decoded: Sequence[Decoded], where: str
) -> list[Finding]:
    """What is missing or damaged. where: what lists the photos, in words."""
    findings: list[Finding] = []
    for frame, (photo, result) in enumerate(zip(photos, decoded, strict=True)):
        for reason, fix in _file_faults(photo, result, where):
            findings.append(Finding(scene, reason, fix, (frame,), (photo.listed.name,)))
    return findings


def _file_faults(photo: Photo, result: Decoded, where: str) -> list[tuple[str, str]]:
    listed, faults = photo.listed, []
    if listed.name and not photo.exists:
        faults.append(
            ("the image does not exist", f"add the file, or remove the frame from {where}")
        )
    if result.error is not None:
        faults.append(
            (
                f"the image cannot be decoded ({result.error})",
                f"replace the file, or remove the frame from {where}",
            )
        )
    if not photo.mask_exists:
        assert listed.mask is not None
        folder = listed.mask.parent.name
        faults.append((f"its mask does not exist in {folder}", "add it, or list no mask"))
    if result.mask_error is not None:
        faults.append((result.mask_error, "replace the mask"))
    return faults

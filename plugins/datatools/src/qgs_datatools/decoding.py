"""Whether photos can be decoded, and have the size that their listing says."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from statistics import median, median_low

from PIL import Image, UnidentifiedImageError

from qgs.data.images import open_mask
from qgs.data.lenses import Size
from qgs.data.photos.checks import size_problems
from qgs_datatools.findings import Finding, Photo

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


_ROUNDING = 1.5  # pixels by which a scaled copy's sides may be off
_CENTRED = 0.1  # of a side: how far from the middle a principal point usually lies at most
_COPY = re.compile(r"images_\d+")


@dataclass(frozen=True)
class _Sized:
    frame: int
    photo: Photo
    file: Size
    listed: Size

    @property
    def said(self) -> str:
        return (
            f"the image is {self.file[1]} x {self.file[0]} pixels, but listed as "
            f"{self.listed[1]} x {self.listed[0]}"
        )

    @property
    def scale(self) -> float:
        return self.file[1] / self.listed[1]

    def has_scale(self, scale: float) -> bool:
        return abs(self.file[1] - scale * self.listed[1]) <= _ROUNDING

    @property
    def is_scaled_copy(self) -> bool:
        height, width = self.listed
        return (
            abs(self.file[0] - height * self.file[1] / width) <= _ROUNDING
            or abs(self.file[1] - width * self.file[0] / height) <= _ROUNDING
        )

    @property
    def is_reduced_folder(self) -> bool:
        return bool(_COPY.fullmatch(self.photo.listed.path.parent.name))

    def finding(self, scene: str, reason: str, fix: str) -> Finding:
        return Finding(scene, reason, fix, (self.frame,), (self.photo.listed.name,))


def size_findings(scene: str, photos: Sequence[Photo], decoded: Sequence[Decoded]) -> list[Finding]:
    """Photos of another shape than listed, of another scale than the rest, or that shrank unasked.

    A scaled copy of the whole scene is right, since intrinsics follow the size; it is told only
    where the folder is not named as one (images_4), and is an error where intrinsics fit the files
    and not the listed size.
    """
    sized = [
        _Sized(frame, photo, result.size, photo.listed.size)
        for frame, (photo, result) in enumerate(zip(photos, decoded, strict=True))
        if result.size is not None and photo.listed.size is not None
    ]
    differing = [item for item in sized if _differs(item)]
    findings = [item.finding(scene, *_told_of_sizes(item)) for item in differing]
    alike = [item for item in sized if item not in differing]
    if not alike:
        return findings
    usual = median_low(item.scale for item in alike)
    odd = [item for item in alike if not item.has_scale(usual)]
    findings += [
        item.finding(scene, f"{item.said}, another scale than the rest of the scene",
                     "give the original image, or one scaled as the others")
        for item in odd
    ]  # fmt: skip
    if usual != 1:
        findings += _scaled(scene, [item for item in alike if item.has_scale(usual)])
    return findings


def _differs(item: _Sized) -> bool:
    exact = item.file == item.listed
    return not exact and (not item.is_scaled_copy or _one_side(item))


def _one_side(item: _Sized) -> bool:
    """Whether one side is as listed and the other is not, which no scale explains."""
    return item.file[0] == item.listed[0] or item.file[1] == item.listed[1]


def _told_of_sizes(item: _Sized) -> tuple[str, str]:
    for problem in size_problems(item.file, item.listed):
        return problem.reason, problem.fix
    return item.said, "give the original image, or correct the listed size"


def _scaled(scene: str, items: Sequence[_Sized]) -> list[Finding]:
    first = items[0]
    if _fits_files_only(items):
        fix = "correct the listed width and height, which the intrinsics do not go with"
        return [item.finding(scene, item.said, fix) for item in items]
    if first.is_reduced_folder:
        return []
    fix = "nothing if they are a scaled copy: intrinsics are scaled alike; else correct the size"
    return [
        Finding(scene, item.said, fix, (item.frame,), (item.photo.listed.name,), "warning")
        for item in items
    ]


def _fits_files_only(items: Sequence[_Sized]) -> bool:
    """Whether principal points lie in the middle of the files, and not of the listed size."""
    return _off_centre(items, "file") <= _CENTRED < _off_centre(items, "listed")


def _off_centre(items: Sequence[_Sized], size: str) -> float:
    def distance(item: _Sized) -> float:
        height, width = getattr(item, size)
        _, _, cx, cy = item.photo.listed.intrinsics
        return max(abs(cx / width - 0.5), abs(cy / height - 0.5))

    return median(map(distance, items))

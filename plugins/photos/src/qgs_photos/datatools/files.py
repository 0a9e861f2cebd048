"""Files that are missing or damaged, and photos of another size than listed."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median, median_low

from qgs.data.images import TURN, TURNED
from qgs.data.lenses import Size
from qgs.data.photos.checks import size_problems
from qgs.data.photos.reader import PhotoFrame
from qgs_photos.datatools.decoding import DecodedScene
from qgs_photos.datatools.findings import Finding, Severity

# Pixels by which a scaled copy's sides may be off.
_ROUNDING = 1.5
# Of a side: how far from the middle a principal point usually lies at most.
_CENTRED = 0.1
_COPY = re.compile(r"images_\d+")


def file_findings(scene: DecodedScene, listing: str) -> Iterator[Finding]:
    """Yield missing and damaged files. listing: name of the file that lists the photos."""
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
class _SizedPhoto:
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

    @property
    def scale(self) -> float:
        return self.file[1] / self.listed[1]

    def has_scale(self, scale: float) -> bool:
        return abs(self.file[1] - scale * self.listed[1]) <= _ROUNDING

    @property
    def is_as_listed_or_scaled(self) -> bool:
        height, width = self.listed
        rows, columns = self.file
        if rows == height or columns == width:
            # one side that is as listed is explained by no scale
            return self.file == self.listed
        by_height = abs(rows - height * columns / width) <= _ROUNDING
        by_width = abs(columns - width * rows / height) <= _ROUNDING
        return by_height or by_width

    def off_centre(self, size: Size) -> float:
        """Return how far the principal point is from the middle of an image, of a side."""
        _, _, cx, cy = self.photo.intrinsics
        return max(abs(cx / size[1] - 0.5), abs(cy / size[0] - 0.5))


def size_findings(scene: DecodedScene) -> Iterator[Finding]:
    """Yield photos of another shape than listed, or of another scale than the rest.

    Then those of a whole scene that was scaled: see `_scaled`.
    """
    scaled = list[_SizedPhoto]()
    for frame, (photo, result) in enumerate(zip(scene.photos, scene.decoded, strict=True)):
        if result.size is None or photo.listed.size is None:
            continue
        item = _SizedPhoto(frame, photo.listed, result.size, photo.listed.size)
        if item.is_as_listed_or_scaled:
            scaled.append(item)
            continue
        problem = next(size_problems(item.file, item.listed), None)
        reason = problem.reason if problem else item.reason
        fix = problem.fix if problem else "give the original image, or correct the listed size"
        yield scene.finding([frame], reason, fix)
    if not scaled:
        return
    usual = median_low(item.scale for item in scaled)
    for item in scaled:
        if not item.has_scale(usual):
            reason = f"{item.reason}, another scale than the rest of the scene"
            fix = "give the original image, or one scaled as the others"
            yield scene.finding([item.frame], reason, fix)
    if usual != 1:
        yield from _scaled(scene, [item for item in scaled if item.has_scale(usual)])


def _scaled(scene: DecodedScene, photos: Sequence[_SizedPhoto]) -> Iterator[Finding]:
    """Yield photos of a scene that is a scaled copy of what is listed.

    Intrinsics follow a copy: it is reported only where its folder is not named as one (images_4),
    and an error where they fit the files and not the listed size.
    """
    in_files = median(item.off_centre(item.file) for item in photos)
    in_listing = median(item.off_centre(item.listed) for item in photos)
    if in_files <= _CENTRED < in_listing:
        severity: Severity = "error"
        fix = "correct the listed width and height, which the intrinsics do not go with"
    elif _COPY.fullmatch(photos[0].photo.path.parent.name):
        return
    else:
        severity = "warning"
        fix = "nothing if they are a scaled copy: intrinsics are scaled too; else correct the size"
    for item in photos:
        yield scene.finding([item.frame], item.reason, fix, severity)

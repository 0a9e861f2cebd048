"""Faults of a data set, one line each, and the photos that are tested."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from PIL import Image

from qgs.data.images import decode_rgb
from qgs.data.lenses import Size, undistorted
from qgs.data.photos.reader import PhotoFrame
from qgs_datatools.conventions import Convention

Severity: TypeAlias = Literal["error", "warning"]

_FEW = 3


@dataclass(frozen=True)
class Finding:
    """A fault and its remedy.

    scene: its name; the file where no scene can be told. frames: their numbers in the listing, from
    0; names: the same frames' names. severity: an error makes results wrong or ends a run.
    """

    scene: str
    reason: str
    fix: str
    frames: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    severity: Severity = "error"

    @property
    def place(self) -> str:
        """The frames in words; empty where the whole scene is meant."""
        if not self.frames:
            return ""
        names = [name for name in self.names if name]
        named = f" ({names[0]}{f' to {names[-1]}' if len(names) > 1 else ''})" if names else ""
        plural = "s" if len(self.frames) > 1 else ""
        return f"frame{plural} {spans(self.frames)}{named}"

    def __str__(self) -> str:
        where = f"{self.scene}, {self.place}" if self.frames else self.scene
        return " ".join(f"{self.severity}: {where}: {self.reason}: {self.fix}".split())


def spans(numbers: Iterable[int]) -> str:
    """Numbers in words, such as 0-3, 7; after eight runs the rest is counted."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    shown = [f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs[:8]]
    more = sum(map(len, runs[8:]))
    return ", ".join(shown) + (f" and {more} more" if more else "")


def merged(findings: Sequence[Finding]) -> list[Finding]:
    """One finding for all frames with the same fault, and for more than three with its remedy.

    The reason that stays is the first frame's.
    """
    alike = _together(findings, lambda finding: (finding.reason, finding.fix, finding.severity))
    kinds = Counter(finding.fix for finding in alike)
    few = [finding for finding in alike if kinds[finding.fix] <= _FEW]
    many = [finding for finding in alike if kinds[finding.fix] > _FEW]
    merged_ = _together(many, lambda finding: (finding.fix, finding.severity))
    return [*few, *merged_]


def _together(
    findings: Sequence[Finding], key: Callable[[Finding], tuple[str, ...]]
) -> list[Finding]:
    together: dict[tuple[str, ...], Finding] = {}
    for finding in findings:
        known = together.get(key(finding))
        together[key(finding)] = finding if known is None else replace(
            known, frames=known.frames + finding.frames, names=known.names + finding.names
        )  # fmt: skip
    return list(together.values())


@dataclass(frozen=True)
class Photo:
    """listed: as the listing says, with the faults that parsing found. read: the file's bytes.

    exists, mask_exists: whether the files that are listed are there.
    """

    listed: PhotoFrame
    read: Callable[[], bytes]
    exists: bool = True
    mask_exists: bool = True

    def picture(self, size: Size | None, side: int) -> tuple[Image.Image, np.ndarray]:
        """The photo as a pinhole camera took it, RGB, with `side` pixels on its longer side.

        size: (H, W) of the file, which intrinsics go with where none is listed. Also the intrinsics
        (4,) in pixels of the picture. Raises OSError for a file that cannot be decoded.
        """
        frame = self.listed if self.listed.size else replace(self.listed, size=size)
        image = decode_rgb(io.BytesIO(self.read()), (1.0, 1.0, 1.0))
        scale = min(1.0, side / max(image.size))
        width, height = (max(1, round(extent * scale)) for extent in image.size)
        image = image.resize((width, height), Image.Resampling.LANCZOS)
        intrinsics = frame.at_size((height, width))
        if frame.lens is not None:
            image = Image.fromarray(undistorted(np.array(image), intrinsics, frame.lens))
        return image, np.array(intrinsics)


@dataclass(frozen=True)
class Candidate:
    """A scene to check, opened by `photos`, which raises ValueError or OSError for a bad listing.

    name: as told; scene: as evaluation indices name it. kind: its format. split: train or test,
    empty where the format knows no such folders.
    """

    name: str
    scene: str
    kind: str
    convention: Convention
    photos: Callable[[], Sequence[Photo]]
    split: str = ""

"""Whether a scene's poses agree with its photos, judged on a few pairs of neighbours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from qgs.data.lenses import Size
from qgs_datatools.conventions import AS_READ, Convention
from qgs_datatools.decoding import Decoded
from qgs_datatools.epipolar import (
    MIN_MATCHES,
    TOLERANCE,
    Features,
    Pair,
    Verdict,
    detect,
    judge,
    match,
)
from qgs_datatools.findings import Finding, Photo

SIDE = 400
"""Pixels on the longer side of the photos that are matched."""

TOO_FEW = f"too few matches, below {MIN_MATCHES} in every pair that was tried"

_RGB_TO_GREY = np.array([0.299, 0.587, 0.114]) / 255
_STARTS = 5
_GAPS = (8, 4, 2, 1)
_NO_BASELINE = 1e-4  # of the cameras' extent: poses so close say nothing about their lines
_ONE_PAIR = 3 * TOLERANCE  # a pair off by more is told though the others agree
_NONSENSE = 0.02  # of the diagonal: no lens or rounding explains more


@dataclass(frozen=True)
class Geometry:
    """verdict: None where nothing could be judged. unjudged: why.

    pairs: the worst first, as read; photos: both of the worst one as it was matched, (H, W, 3)
    uint8. diagonal: of the photos' files, in pixels.
    """

    pairs: Sequence[Pair] = ()
    photos: tuple[np.ndarray, ...] = ()
    verdict: Verdict | None = None
    diagonal: float = 0.0
    unjudged: str = ""

    @property
    def fraction(self) -> float:
        """Median distance to the epipolar line as read, as a fraction of the diagonal."""
        assert self.verdict is not None
        return self.verdict.distances[AS_READ]

    @property
    def pixels(self) -> float:
        """The same in pixels of the files."""
        return self.fraction * self.diagonal


@dataclass
class _Scene:
    photos: Sequence[Photo]
    decoded: Sequence[Decoded]
    frames: Sequence[int]
    _features: dict[int, tuple[Features, np.ndarray, Size]] = field(default_factory=dict)

    @cached_property
    def centres(self) -> np.ndarray:
        return np.stack([self.photos[frame].listed.c2w[:3, 3] for frame in self.frames])

    def picture(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        picture, intrinsics = self.photos[frame].picture(self.decoded[frame].size, SIDE)
        return np.asarray(picture), intrinsics

    def features(self, frame: int) -> tuple[Features, np.ndarray, Size]:
        if frame not in self._features:
            picture, intrinsics = self.picture(frame)
            self._features[frame] = detect(picture @ _RGB_TO_GREY), intrinsics, picture.shape[:2]
        return self._features[frame]

    def pair(self, first: int, second: int) -> Pair | None:
        """Frames by their places in `frames`; None where too little is shared."""
        numbers = (self.frames[first], self.frames[second])
        (one, k1, size), (two, k2, _) = map(self.features, numbers)
        matches = match(one, two)
        if not len(matches):
            return None
        poses = np.stack([self.photos[number].listed.c2w for number in numbers])
        return Pair(numbers, matches, poses, np.stack([k1, k2]), size)

    def partners(self, start: int) -> Iterator[int]:
        """Places of frames that may see the same: along the listing, then near in space."""
        along = [
            place
            for gap in _GAPS
            for place in (start + gap, start - gap)
            if 0 <= place < len(self.frames)
        ]
        forward = [place for place in along if place > start] or along
        near = np.argsort(np.linalg.norm(self.centres - self.centres[start], axis=1))
        extent = np.ptp(self.centres, axis=0).max()
        for place in dict.fromkeys([*forward, *near[1:4].tolist()]):
            apart = np.linalg.norm(self.centres[place] - self.centres[start])
            if place != start and apart > _NO_BASELINE * extent:
                yield place


def judge_scene(
    photos: Sequence[Photo],
    decoded: Sequence[Decoded],
    sound: Sequence[int],
    convention: Convention,
) -> Geometry:
    """Match up to five pairs, spread over the frames that are `sound`.

    Raises MissingExtraError without scikit-image.
    """
    if len(sound) < 2:
        return Geometry(unjudged="fewer than 2 sound frames")
    scene = _Scene(photos, decoded, sound)
    if not np.ptp(scene.centres, axis=0).any():
        return Geometry(unjudged="all cameras on one point")
    pairs = [pair for start in _starts(len(sound)) if (pair := _first_pair(scene, start))]
    if not pairs:
        return Geometry(unjudged=TOO_FEW)
    pairs.sort(key=lambda pair: -pair.distance())
    shown = tuple(scene.picture(frame)[0] for frame in pairs[0].frames)
    size = decoded[pairs[0].frames[0]].size
    assert size is not None
    return Geometry(pairs, shown, judge(pairs, convention), float(np.hypot(*size)))


def _starts(count: int) -> list[int]:
    return list(dict.fromkeys(np.linspace(0, count - 2, _STARTS).round().astype(int).tolist()))


def _first_pair(scene: _Scene, start: int) -> Pair | None:
    pairs = (scene.pair(start, place) for place in scene.partners(start))
    return next((pair for pair in pairs if pair is not None), None)


def geometry_findings(
    scene: str, geometry: Geometry, photos: Sequence[Photo], convention: Convention
) -> list[Finding]:
    """What the verdict means for the scene; a warning where there is none."""
    if geometry.verdict is None:
        return [
            Finding(
                scene,
                f"the poses are not judged against the photos: {geometry.unjudged}",
                "look at the cameras yourself, in the picture that --report draws",
                severity="warning",
            )
        ]
    frames = tuple(range(len(photos)))
    names = tuple(photo.listed.name for photo in photos)
    said = _said(geometry)
    if geometry.verdict.better is not None:
        misreading = convention.misreadings[geometry.verdict.better]
        after = geometry.verdict.distances[geometry.verdict.better] * geometry.diagonal
        reason = f"{misreading.reason} ({said}; {after:.1f} when read so)"
        return [Finding(scene, reason, misreading.fix, frames, names)]
    if not geometry.verdict.agrees:
        bad = geometry.verdict.distances[AS_READ] > _NONSENSE
        return [
            Finding(
                scene,
                f"the poses do not explain the photos ({said}), nor in another convention",
                "check that poses and photos are in the same order, and the intrinsics",
                frames,
                names,
                "error" if bad else "warning",
            )
        ]
    return [_odd_pair(scene, pair, photos, geometry) for pair in geometry.pairs
            if pair.distance() > _ONE_PAIR]  # fmt: skip


def _said(geometry: Geometry) -> str:
    return (
        f"matches lie {geometry.pixels:.1f} pixels from their epipolar lines, "
        f"median of {len(geometry.pairs)} pairs"
    )


def _odd_pair(scene: str, pair: Pair, photos: Sequence[Photo], geometry: Geometry) -> Finding:
    return Finding(
        scene,
        f"the two poses do not fit each other: matches lie "
        f"{pair.distance() * geometry.diagonal:.1f} pixels from their epipolar lines",
        "correct the pose of one of them, or remove it",
        pair.frames,
        tuple(photos[frame].listed.name for frame in pair.frames),
        "warning",
    )

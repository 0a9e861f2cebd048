"""Whether a scene's poses agree with its photos, judged on a few pairs of neighbours."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from qgs_datatools.conventions import Convention
from qgs_datatools.decoding import DecodedScene
from qgs_datatools.epipolar import MIN_MATCHES, Features, Pair, detect, match
from qgs_datatools.findings import Finding

AS_READ = "as read"  # the reading of poses that changes nothing
SIDE = 400  # pixels on the longer side of the photos that are matched
TOLERANCE = 0.005  # largest median distance that good poses leave, of the image's diagonal
CLEARLY_BETTER = 3.0  # a reading whose distance is this many times smaller replaces the present one
TOO_FEW = f"too few matches, below {MIN_MATCHES} in every pair that was tried"
_RGB_TO_GREY = np.array([0.299, 0.587, 0.114]) / 255
_STARTS = 5
_GAPS = (8, 4, 2, 1)
_NO_BASELINE = 1e-4  # of the cameras' extent: poses so close say nothing about their lines
_ONE_PAIR = 3 * TOLERANCE  # a pair off by more is reported though the others agree
_NONSENSE = 0.02  # of the diagonal: no lens or rounding explains more


@dataclass(frozen=True)
class Geometry:
    """How well the poses of a scene explain its photos.

    distances: median over pairs of the distance of matches to epipolar lines by reading of the
    poses, fractions of the diagonal; empty where `unjudged` says why. pairs: the worst first;
    photos: both of the worst one, (H, W, 3) uint8. diagonal: of the files, in pixels. labels: what
    messages call the photos.
    """

    distances: Mapping[str, float] = field(default_factory=dict)
    unjudged: str = ""
    pairs: Sequence[Pair] = ()
    photos: tuple[np.ndarray, ...] = ()
    diagonal: float = 0.0
    labels: tuple[str, ...] = ()

    @property
    def fraction(self) -> float:
        """Median distance to the epipolar line as read, as a fraction of the diagonal."""
        return self.distances[AS_READ]

    @property
    def pixels(self) -> float:
        """The same in pixels of the files."""
        return self.fraction * self.diagonal

    @property
    def better(self) -> str | None:
        """The reading that explains the photos where the present one does not."""
        best = min(self.distances, key=lambda reading: self.distances[reading])
        clear = self.fraction > CLEARLY_BETTER * self.distances[best]
        return best if clear and self.distances[best] <= TOLERANCE else None

    @property
    def agrees(self) -> bool:
        """Whether the poses, as read, explain the photos."""
        return self.fraction <= TOLERANCE and self.better is None


def judge_scene(scene: DecodedScene, usable: Sequence[int], convention: Convention) -> Geometry:
    """Match up to five pairs, spread over the frames that are `usable`."""
    if len(usable) < 2:
        return Geometry(unjudged="fewer than 2 usable frames")
    matcher = _Matcher(scene, usable)
    if not np.ptp(matcher.centres, axis=0).any():
        return Geometry(unjudged="all cameras on one point")
    starts = np.linspace(0, len(usable) - 2, _STARTS).round().astype(int).tolist()
    pairs = [pair for start in dict.fromkeys(starts) for pair in islice(matcher.pairs(start), 1)]
    if not pairs:
        return Geometry(unjudged=TOO_FEW)
    pairs.sort(key=lambda pair: -pair.distance())
    readings = {AS_READ: np.asarray, **{name: m.meant for name, m in convention.items()}}
    distances = {
        name: float(np.median([pair.distance(reading) for pair in pairs]))
        for name, reading in readings.items()
    }
    photos = tuple(matcher.picture(frame)[0] for frame in pairs[0].frames)
    size = scene.decoded[pairs[0].frames[0]].size
    assert size is not None
    labels = tuple(map(scene.label, pairs[0].frames))
    return Geometry(distances, "", pairs, photos, float(np.hypot(*size)), labels)


class _Matcher:
    """Pairs of a scene's frames, by their places in `frames`; features are detected once."""

    def __init__(self, scene: DecodedScene, frames: Sequence[int]) -> None:
        self.scene, self.frames = scene, frames
        self.poses = np.stack([scene.photos[frame].listed.c2w for frame in frames])
        self.centres = self.poses[:, :3, 3]
        self._features: dict[int, tuple[Features, np.ndarray, tuple[int, int]]] = {}

    def picture(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """The photo as it is matched, and its intrinsics; by its number in the scene."""
        return self.scene.photos[frame].picture(self.scene.decoded[frame].size, SIDE)

    def pairs(self, start: int) -> Iterator[Pair]:
        """The frame at `start` with each of its partners that shares enough with it."""
        return filter(None, (self.pair(start, place) for place in self.partners(start)))

    def pair(self, first: int, second: int) -> Pair | None:
        """None where too little is shared."""
        for place in {first, second} - self._features.keys():
            picture, intrinsics = self.picture(self.frames[place])
            height, width, _ = picture.shape
            self._features[place] = detect(picture @ _RGB_TO_GREY), intrinsics, (height, width)
        (one, k1, size), (two, k2, _) = self._features[first], self._features[second]
        matches = match(one, two)
        if matches is None:
            return None
        frames, poses = (self.frames[first], self.frames[second]), self.poses[[first, second]]
        return Pair(frames, matches, poses, np.stack([k1, k2]), size)

    def partners(self, start: int) -> Iterator[int]:
        """Places of frames that may see the same: along the listing, then near in space."""
        along = [place for gap in _GAPS for place in (start + gap, start - gap)]
        along = [place for place in along if 0 <= place < len(self.frames)]
        forward = [place for place in along if place > start] or along
        near = np.argsort(np.linalg.norm(self.centres - self.centres[start], axis=1))
        extent = np.ptp(self.centres, axis=0).max()
        for place in dict.fromkeys([*forward, *near[1:4].tolist()]):
            distance = np.linalg.norm(self.centres[place] - self.centres[start])
            if place != start and distance > _NO_BASELINE * extent:
                yield place


def geometry_findings(
    scene: DecodedScene, geometry: Geometry, convention: Convention
) -> Iterator[Finding]:
    """What the distances mean for the scene; a warning where there are none."""
    if not geometry.distances:
        reason = f"the poses are not judged against the photos: {geometry.unjudged}"
        fix = "look at the cameras yourself, in the picture that --report draws"
        yield Finding(scene.name, reason, fix, severity="warning")
        return
    frames = range(len(scene.photos))
    off = (
        f"matches lie {geometry.pixels:.1f} pixels from their epipolar lines, "
        f"median of {len(geometry.pairs)} pairs"
    )
    if geometry.better is not None:
        misreading = convention[geometry.better]
        after = geometry.distances[geometry.better] * geometry.diagonal
        reason = f"{misreading.reason} ({off}; {after:.1f} when read so)"
        yield scene.finding(frames, reason, misreading.fix)
    elif not geometry.agrees:
        reason = f"the poses do not explain the photos ({off}), nor in another convention"
        fix = "check that poses and photos are in the same order, and the intrinsics"
        moves = len({photo.listed.time for photo in scene.photos}) > 1  # and what moves lies off
        severity = "error" if geometry.fraction > _NONSENSE and not moves else "warning"
        yield scene.finding(frames, reason, fix, severity)
    else:
        for pair in geometry.pairs:
            if (distance := pair.distance()) > _ONE_PAIR:
                reason = (
                    "the two poses do not fit each other: matches lie "
                    f"{distance * geometry.diagonal:.1f} pixels from their epipolar lines"
                )
                fix = "correct the pose of one of them, or remove it"
                yield scene.finding(pair.frames, reason, fix, "warning")

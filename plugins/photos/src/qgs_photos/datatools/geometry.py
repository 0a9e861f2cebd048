"""Whether a scene's cameras agree with its photos, judged on pairs of neighbours."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from qgs_photos.datatools.conventions import Convention
from qgs_photos.datatools.decoding import DecodedScene
from qgs_photos.datatools.epipolar import MIN_MATCHES, Features, Pair, detect, match
from qgs_photos.datatools.findings import Finding
from qgs_photos.datatools.suspects import (
    OtherLens,
    exchanged_poses,
    frames_of_other_channels,
    frames_off,
    other_lens,
)

AS_READ = "as read"  # the reading of poses that changes nothing
SIDE = 400  # pixels on the longer side of the photos that are matched
TOLERANCE = 0.005  # largest median distance that good poses leave, of the image's diagonal
CLEARLY_BETTER = 3.0  # a reading whose distance is this many times smaller replaces the present one
TOO_FEW = f"too few matches, below {MIN_MATCHES} in every pair that was tried"
_RUNS = 5  # of consecutive frames, where not all are matched
_GAPS = (8, 4, 2, 1)
_NO_BASELINE = 1e-4  # of the cameras' extent: poses so close say nothing about their lines
_NONSENSE = 0.02  # of the diagonal: no lens or rounding explains more


@dataclass(frozen=True)
class Geometry:
    """How well the poses of a scene explain its photos.

    distances: median over pairs of the distance of matches to epipolar lines by reading of the
    poses, fractions of the diagonal; empty where `unjudged` says why. pairs: the worst first;
    photos: both of the worst one, (H, W, 3) uint8. diagonal: of the files, in pixels. labels: what
    messages call the photos. left_out: frames that were not matched.
    """

    distances: Mapping[str, float] = field(default_factory=dict)
    unjudged: str = ""
    pairs: Sequence[Pair] = ()
    photos: tuple[np.ndarray, ...] = ()
    diagonal: float = 0.0
    labels: tuple[str, ...] = ()
    left_out: int = 0

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


def judge_scene(
    scene: DecodedScene, usable: Sequence[int], convention: Convention, most: int
) -> Geometry:
    """Match each frame that is `usable`, of runs of at most `most`, with the next and another."""
    if len(usable) < 2:
        return Geometry(unjudged="fewer than 2 usable frames")
    matcher = _Matcher(scene, [frame for run in _runs(usable, most) for frame in run])
    if not np.ptp(matcher.centres, axis=0).any():
        return Geometry(unjudged="all cameras on one point")
    pairs = matcher.pairs()
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
    left_out = len(usable) - len(matcher.frames)
    return Geometry(distances, "", pairs, photos, float(np.hypot(*size)), labels, left_out)


def _runs(frames: Sequence[int], most: int) -> list[Sequence[int]]:
    """All frames, or runs of neighbours, spread over them, that together have `most`."""
    if len(frames) <= most:
        return [frames]
    length = max(most // _RUNS, 2)
    starts = np.linspace(0, len(frames) - length, most // length).astype(int)
    return [frames[start : start + length] for start in starts]


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

    def pairs(self) -> list[Pair]:
        """Each frame with the next one, and with the first of its partners that shares enough."""
        found: dict[frozenset[int], Pair | None] = {}
        for start in range(len(self.frames)):
            partners = list(self.partners(start))
            for group in ([p for p in partners if p == start + 1], partners):
                for place in group:
                    both = frozenset((start, place))
                    if both not in found:
                        found[both] = self.pair(min(both), max(both))
                    if found[both]:
                        break
        return [*filter(None, found.values())]

    def pair(self, first: int, second: int) -> Pair | None:
        """None where too little is shared."""
        for place in {first, second} - self._features.keys():
            picture, intrinsics = self.picture(self.frames[place])
            height, width, _ = picture.shape
            self._features[place] = detect(picture), intrinsics, (height, width)
        (one, k1, size), (two, k2, _) = self._features[first], self._features[second]
        matches = match(one, two)
        if matches is None:
            return None
        frames, poses = (self.frames[first], self.frames[second]), self.poses[[first, second]]
        return Pair(frames, *matches, poses, np.stack([k1, k2]), size)

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
    elif both := exchanged_poses(geometry.pairs, TOLERANCE):
        reason = "their poses look exchanged: with each other's they fit those of the other frames"
        yield scene.finding(both, reason, "exchange the two poses, or the two photos")
    elif lens := other_lens(geometry.pairs, TOLERANCE):
        yield _of_lens(scene, geometry, lens)
    elif not geometry.agrees:
        reason = f"the poses do not explain the photos ({off}), nor in another convention"
        fix = "check that poses and photos are in the same order, and the intrinsics"
        moves = len({photo.listed.time for photo in scene.photos}) > 1  # and what moves lies off
        severity = "error" if geometry.fraction > _NONSENSE and not moves else "warning"
        yield scene.finding(frames, reason, fix, severity)
    elif off_frames := frames_off(geometry.pairs, TOLERANCE):
        reason = "the pose or the intrinsics do not fit those of the other frames"
        fix = "check that it belongs to the photo, correct it, or remove the frame"
        yield scene.finding(off_frames, reason, fix, "warning")
    if channels := frames_of_other_channels(geometry.pairs):
        every = {frame for pair in geometry.pairs for frame in pair.frames}
        which = ", or in all others" if 2 * len(channels) == len(every) else ""
        reason = (
            f"red and blue look exchanged{which}: what other photos show too has their colours so"
        )
        yield scene.finding(channels, reason, "write the photo as RGB, not as BGR", "warning")


def _of_lens(scene: DecodedScene, geometry: Geometry, lens: OtherLens) -> Finding:
    """A finding on intrinsics that do not fit the photos, and on those that do."""
    pair, scale = geometry.pairs[0], geometry.diagonal / np.hypot(*geometry.pairs[0].size)
    fx, _, cx, cy = scale * pair.intrinsics[0]
    change = scale * max(pair.size) * np.array(lens.shift)
    off = (
        f"matches lie {lens.before * geometry.diagonal:.1f} pixels from their epipolar lines, "
        f"and {lens.after * geometry.diagonal:.1f}"
    )
    if lens.exchanged:
        reason = f"cx and cy look exchanged ({off} with cx {cy:.0f}, cy {cx:.0f})"
        fix = "exchange them"
    elif not change.any():
        reason = f"the focal lengths do not fit the photos ({off} with {lens.zoom:.2f} times them)"
        fix = "correct them, or the size that goes with them; photos that were cut have other ones"
    else:
        x, y = np.array([cx, cy]) + change
        reason = (
            f"the intrinsics do not fit the photos ({off} with a focal length of "
            f"{fx * lens.zoom:.0f} instead of {fx:.0f} and a principal point ({x:.0f}, {y:.0f}) "
            f"instead of ({cx:.0f}, {cy:.0f}))"
        )
        fix = "give those of the photos as they are; cutting moves cx and cy, scaling changes all"
    severity = "error" if geometry.fraction > TOLERANCE else "warning"
    return scene.finding(range(len(scene.photos)), reason, fix, severity)

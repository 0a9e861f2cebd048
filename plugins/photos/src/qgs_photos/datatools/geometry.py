"""Whether a scene's cameras agree with its photos, judged on pairs of neighbours."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from qgs.wording import counted
from qgs_photos.datatools.decoding import DecodedScene
from qgs_photos.datatools.epipolar import MIN_MATCHES, Features, Pair, detect, frames_above, match
from qgs_photos.datatools.findings import Finding, Severity

# Pixels on the longer side of the photos that are matched.
SIDE = 400
# Largest median distance that good poses leave, of the image's diagonal.
TOLERANCE = 0.005
TOO_FEW = f"too few matches, below {MIN_MATCHES} in every pair that was tried"
# Of consecutive frames, where not all are matched.
_RUNS = 5
_GAPS = (8, 4, 2, 1)
# Of the cameras' extent: poses so close say nothing about their lines.
_NO_BASELINE = 1e-4
# Of the diagonal: no lens or rounding explains more.
_NONSENSE = 0.02
# Times the better pairs: a frame is off that is so far from all its partners.
_FAR = 4.0
_ADVICE = (
    "check the convention of the poses, that they are in the order of the photos, and the "
    "intrinsics; docs/photos.md says how each looks"
)


@dataclass(frozen=True)
class Geometry:
    """How well the poses of a scene explain its photos.

    unjudged: why there are no `pairs`. pairs: the worst first; photos: both of that one, (H, W, 3)
    uint8. diagonal: of the files, in pixels. labels: what messages call the photos. left_out:
    frames that were not matched.
    """

    unjudged: str = ""
    pairs: Sequence[Pair] = ()
    photos: tuple[np.ndarray, ...] = ()
    diagonal: float = 0.0
    labels: tuple[str, ...] = ()
    left_out: int = 0

    @property
    def fraction(self) -> float:
        """Median over pairs of their distance, of the diagonal; 0 for none."""
        return float(np.median([pair.distance for pair in self.pairs])) if self.pairs else 0.0

    @property
    def pixels(self) -> float:
        """The same in pixels of the files."""
        return self.fraction * self.diagonal

    @property
    def agrees(self) -> bool:
        """Whether the poses explain the photos."""
        return self.fraction <= TOLERANCE


def judge_scene(scene: DecodedScene, usable: Sequence[int], most: int) -> Geometry:
    """Match each frame that is `usable`, of runs of at most `most`, with the next and another."""
    if len(usable) < 2:
        return Geometry("fewer than 2 usable frames")
    matcher = _Matcher(scene, [frame for run in _runs(usable, most) for frame in run])
    # no baseline, no epipolar lines
    if not np.ptp(matcher.centres, axis=0).any():
        return Geometry("all cameras on one point")
    pairs = sorted(matcher.pairs(), key=lambda pair: -pair.distance)
    if not pairs:
        return Geometry(TOO_FEW)
    frames = pairs[0].frames
    size = scene.decoded[frames[0]].size
    assert size is not None
    return Geometry(
        pairs=pairs,
        photos=tuple(matcher.picture(frame)[0] for frame in frames),
        diagonal=float(np.hypot(*size)),
        labels=tuple(map(scene.label, frames)),
        left_out=len(usable) - len(matcher.frames),
    )


def _runs(frames: Sequence[int], most: int) -> list[Sequence[int]]:
    """Return all frames, or runs of neighbours, spread over them, that together have `most`."""
    if len(frames) <= most:
        return [frames]
    length = max(most // _RUNS, 2)
    starts = np.linspace(0, len(frames) - length, most // length).astype(int)
    return [frames[start : start + length] for start in starts]


class _Matcher:
    """Pairs of a scene's frames, by their places in `frames`; features are detected once."""

    def __init__(self, scene: DecodedScene, frames: Sequence[int]) -> None:
        self.scene = scene
        self.frames = frames
        self.poses = np.stack([scene.photos[frame].listed.c2w for frame in frames])
        self.centres = self.poses[:, :3, 3]
        self._known: dict[int, tuple[Features, np.ndarray, tuple[int, int]]] = {}

    def picture(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the photo as it is matched, and its intrinsics; by its number in the scene."""
        return self.scene.photos[frame].picture(self.scene.decoded[frame].size, SIDE)

    def pairs(self) -> list[Pair]:
        """Pair each frame with the next, and with the first of its partners that shares enough."""
        found: dict[frozenset[int], Pair | None] = {}
        for start in range(len(self.frames)):
            # the next shares most and says least; a farther one has a baseline
            partners = list(self.partners(start))
            for group in ([p for p in partners if p == start + 1], partners):
                for place in group:
                    both = frozenset((start, place))
                    if both not in found:
                        found[both] = self.pair(min(both), max(both))
                    if found[both]:
                        break
        return [pair for pair in found.values() if pair]

    def pair(self, first: int, second: int) -> Pair | None:
        """Match two photos; None where too little is shared."""
        one, lens_of_one, size = self._features(first)
        two, lens_of_two, _ = self._features(second)
        found = match(one, two)
        if found is None:
            return None
        rows = found.T
        return Pair(
            frames=(self.frames[first], self.frames[second]),
            matches=np.stack([one.points[rows[0]], two.points[rows[1]]]),
            colors=np.stack([one.colors[rows[0]], two.colors[rows[1]]]),
            poses=self.poses[[first, second]],
            intrinsics=np.stack([lens_of_one, lens_of_two]),
            size=size,
        )

    def _features(self, place: int) -> tuple[Features, np.ndarray, tuple[int, int]]:
        if place not in self._known:
            picture, intrinsics = self.picture(self.frames[place])
            height, width, _ = picture.shape
            self._known[place] = detect(picture), intrinsics, (height, width)
        return self._known[place]

    def partners(self, start: int) -> Iterator[int]:
        """Places of frames that may see the same: along the listing, then near in space."""
        along = [place for gap in _GAPS for place in (start + gap, start - gap)]
        along = [place for place in along if 0 <= place < len(self.frames)]
        forward = [place for place in along if place > start] or along
        distances = np.linalg.norm(self.centres - self.centres[start], axis=1)
        near = np.argsort(distances)[1:4].tolist()
        least = _NO_BASELINE * np.ptp(self.centres, axis=0).max()
        for place in dict.fromkeys([*forward, *near]):
            if place != start and distances[place] > least:
                yield place


def geometry_findings(scene: DecodedScene, geometry: Geometry) -> Iterator[Finding]:
    """Yield what the distances mean for the scene; a warning where there are none."""
    if geometry.unjudged:
        reason = f"the poses are not judged against the photos: {geometry.unjudged}"
        fix = "look at the cameras yourself, in the picture that --report draws"
        yield Finding(scene.name, reason, fix, severity="warning")
        return
    # what moves lies off its lines, however good the poses are
    moves = len({photo.listed.time for photo in scene.photos}) > 1
    distances = [(pair.frames, pair.distance) for pair in geometry.pairs]

    def severity(fraction: float) -> Severity:
        return "error" if fraction > _NONSENSE and not moves else "warning"

    better = float(np.quantile([distance for _, distance in distances], 0.25))
    off = frames_above(distances, max(min(_FAR * better, _NONSENSE), TOLERANCE))
    rest = [distance for frames, distance in distances if off.keys().isdisjoint(frames)]
    # a few wrong frames are in most of the pairs of a short scene: without them it must agree
    if off and rest and np.median(rest) <= TOLERANCE:
        reason = "the pose or the intrinsics do not fit those of the other frames"
        fix = "check that they belong to the photo, correct them, or remove the frame"
        yield scene.finding(sorted(off), reason, fix, severity(min(off.values())))
    elif not geometry.agrees:
        reason = (
            f"the poses do not fit the photos: matches lie {geometry.pixels:.1f} pixels from where "
            f"they may be seen, median of {counted(len(geometry.pairs), 'pair')}; good poses leave "
            f"up to {TOLERANCE * geometry.diagonal:.1f}"
        )
        every = range(len(scene.photos))
        yield scene.finding(every, reason, _ADVICE, severity(geometry.fraction))
    differ = [(pair.frames, float(pair.channels_differ)) for pair in geometry.pairs]
    if exchanged := frames_above(differ, 0.5):
        reason = "red and blue look exchanged: what other photos show too has their colours so"
        fix = "write the photo as RGB, not as BGR"
        yield scene.finding(sorted(exchanged), reason, fix, "warning")

"""Which frames of matched pairs do not fit the others, and which intrinsics would fit better."""

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from qgs_photos.datatools.epipolar import Pair

_POOR = 2.0  # times the distance of the better pairs; sound ones of exact poses reach 1.6
_NOISE = 0.0008  # of the diagonal: what matches alone are off by, 0.4 of 500 pixels
_MOST_SUSPECTS = 24  # frames of poor pairs whose exchange is tried
_CURED = 4  # poor pairs before an exchange for each one after it; photographed poses are not exact
_FAR = 4.0  # times the better pairs: a frame is off that is so far from all its partners
_LENS_PAIRS = 30  # are enough for three numbers, of those far apart, which say most
_LENS_MATCHES = 80  # of a pair: more change its median little
_CLEARLY = 1.3  # times smaller with other intrinsics; three free numbers gain sound scenes 1.2
_AS_GOOD = 1.25  # times the best fit's distance: a simpler explanation that explains it too
_LEAST_CHANGE = 0.04  # of the focal length, or of the longer side: less is no mistake
_SWAPPED = 1.5  # times nearer in colour with red and blue exchanged
_COLORED = 0.02  # of the range: greyer matches cannot tell


def better_quarter(pairs: Sequence[Pair]) -> float:
    """The distance of pairs that no fault of a few frames touches, of the diagonal."""
    return max(float(np.quantile([pair.distance() for pair in pairs], 0.25)), _NOISE)


def exchanged_poses(pairs: Sequence[Pair], most: float) -> tuple[int, int] | None:
    """Two frames with which nearly all pairs that are off fit, once their poses are exchanged.

    most: distance of sound pairs at most, of the diagonal, for two of few frames touch most pairs.
    """
    limit = min(_POOR * better_quarter(pairs), most)
    poor = Counter(f for pair in pairs if pair.distance() > limit for f in pair.frames)
    poses = {f: pose for pair in pairs for f, pose in zip(pair.frames, pair.poses, strict=True)}
    found: tuple[float, tuple[int, int]] | None = None
    for one, two in combinations(sorted(f for f, _ in poor.most_common(_MOST_SUSPECTS)), 2):
        other = {**poses, one: poses[two], two: poses[one]}
        touched = [pair for pair in pairs if {one, two} & {*pair.frames}]
        moved = [replace(p, poses=np.stack([other[f] for f in p.frames])) for p in touched]
        before, after = (np.array([p.distance() for p in group]) for group in (touched, moved))
        cured = (before > limit).sum() >= max(_CURED * (after > limit).sum(), 2)
        gain = float((np.minimum(before, 4 * limit) - np.minimum(after, 4 * limit)).sum())
        if cured and (found is None or gain > found[0]):
            found = gain, (one, two)
    return found[1] if found else None


def frames_off(pairs: Sequence[Pair], least: float) -> list[int]:
    """Frames whose pose fits none of their partners'; least: a distance up to which it does."""
    limit = max(_FAR * better_quarter(pairs), least)
    return above_in_all([(pair.frames, pair.distance()) for pair in pairs], limit)


def above_in_all(values: Sequence[tuple[tuple[int, int], float]], limit: float) -> list[int]:
    """Frames of two pairs or more whose values are all above `limit`.

    The worst goes first with its pairs, so that its partners are not blamed.
    """
    off = list[int]()
    while True:
        of_frame = defaultdict[int, list[float]](list)
        for frames, value in values:
            for frame in frames:
                of_frame[frame].append(value)
        above = {f: v for f, v in of_frame.items() if len(v) > 1 and min(v) > limit}
        if not above:
            return sorted(off)
        off.append(max(above, key=lambda frame: (len(above[frame]), sum(above[frame]))))
        values = [item for item in values if off[-1] not in item[0]]


def frames_of_other_channels(pairs: Sequence[Pair]) -> list[int]:
    """The fewer of the frames whose red and blue are exchanged against the others'."""
    odd = {pair.frames: _channels_differ(pair) for pair in pairs}
    sides: dict[int, bool] = {}
    while rest := [f for frames in odd for f in frames if f not in sides]:
        sides[rest[0]], grown = False, True
        while grown:
            grown = False
            for (one, two), differs in odd.items():
                for known, new in ((one, two), (two, one)):
                    if known in sides and new not in sides:
                        sides[new], grown = sides[known] ^ differs, True
    other = [frame for frame, side in sides.items() if side]
    return sorted(other if 2 * len(other) <= len(sides) else sides.keys() - {*other})


def _channels_differ(pair: Pair) -> bool:
    one, two = pair.colors[..., 0] - pair.colors[..., 2]  # exposure moves all channels together
    same, swapped = (float(np.median(np.abs(one - other))) for other in (two, -two))
    return same > max(_SWAPPED * swapped, _COLORED)


@dataclass(frozen=True)
class OtherLens:
    """Intrinsics that fit better. zoom: of the focal lengths. shift: (x, y) of the longer side.

    before, after: median distances, of the diagonal. exchanged: whether cx and cy are.
    """

    before: float
    after: float
    zoom: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    exchanged: bool = False


def other_lens(pairs: Sequence[Pair], most: float) -> OtherLens | None:
    """Other intrinsics, of all frames alike, with which pairs are clearly nearer; else None.

    most: distance up to which they are an explanation, of the diagonal.
    """
    wide = sorted(pairs, key=lambda pair: pair.baseline)[len(pairs) // 2 :]
    pairs = [_thinned(pair) for pair in wide[:: -(-len(wide) // _LENS_PAIRS)]]

    def off(change: np.ndarray) -> float:
        return _median([_changed(pair, *change) for pair in pairs])

    before = off(np.zeros(3))
    grid = [np.array([zoom, 0.0, 0.0]) for zoom in np.linspace(-0.6, 0.6, 9)]
    start = min(grid, key=off)
    zoomed, of_zoom = _descended(off, start, 1)
    starts = [zoomed, np.zeros(3)] if zoomed.any() else [zoomed]
    best, after = min((_descended(off, start, 3) for start in starts), key=_value)
    if after > most or before < _CLEARLY * after or np.abs(best).max() < _LEAST_CHANGE:
        return None
    swapped = [replace(p, intrinsics=p.intrinsics[:, [0, 1, 3, 2]]) for p in pairs]
    if (distance := _median(swapped)) * _CLEARLY <= before and distance <= _AS_GOOD * after:
        return OtherLens(before, distance, exchanged=True)
    if of_zoom <= _AS_GOOD * after and of_zoom * _CLEARLY <= before:
        best, after = zoomed, of_zoom
    return OtherLens(before, after, float(np.exp(best[0])), (float(best[1]), float(best[2])))


def _thinned(pair: Pair) -> Pair:
    return replace(pair, matches=pair.matches[:, :: -(-pair.matches.shape[1] // _LENS_MATCHES)])


def _value(found: tuple[np.ndarray, float]) -> float:
    return found[1]


def _median(pairs: Sequence[Pair]) -> float:
    return float(np.median([pair.distance() for pair in pairs]))


def _changed(pair: Pair, zoom: float, x: float, y: float) -> Pair:
    """zoom: logarithm of a factor of the focal lengths; x, y: as `OtherLens.shift`."""
    shift = np.array([0, 0, x, y]) * max(pair.size)
    return replace(pair, intrinsics=pair.intrinsics * np.exp([zoom, zoom, 0, 0]) + shift)


def _descended(
    off: Callable[[np.ndarray], float], start: np.ndarray, free: int
) -> tuple[np.ndarray, float]:
    """The least of `off` near `start` by steps along its first `free` axes, and its value."""
    best, value, step = start, off(start), 0.1
    axes = np.concatenate([np.eye(3)[:free], -np.eye(3)[:free]])
    while step > 0.005:
        found = min(((best + step * axis, off(best + step * axis)) for axis in axes), key=_value)
        if found[1] < value:
            best, value = found
        else:
            step /= 2
    return best, value

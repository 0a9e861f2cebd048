"""Check the cameras of photos by matching features in pairs of neighbouring photos."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import torch
from kornia.feature import match_smnn
from kornia.geometry.ransac import RANSAC
from skimage.feature import SIFT

from qgs.data.images import TURN
from qgs.wording import counted
from qgs_photos.datatools.findings import Finding, Severity
from qgs_photos.datatools.photos import DecodedScene

# Pixels on the longer side of the photos that are matched.
SIDE = 400
# Fewer matches say nothing about a pair of photos.
MIN_MATCHES = 24
# Largest median distance that good poses leave, of the image's diagonal.
TOLERANCE = 0.005
TOO_FEW = f"too few matches, below {MIN_MATCHES} in every pair that was tried"
# Of descriptor distances (Lowe 2004).
_RATIO = 0.8
_INLIER_PIXELS = 1.5
_RGB_TO_GREY = np.array([0.299, 0.587, 0.114]) / 255
# Of consecutive frames, where not all are matched.
_RUNS = 5
_GAPS = (8, -8, 4, -4, 2, -2, 1, -1)
# Of the cameras' extent: poses so close say nothing about their lines.
_NO_BASELINE = 1e-4
# Of the diagonal: no lens or rounding explains more.
_NONSENSE = 0.02
# Times the better pairs: a frame is off that is so far from all its partners.
_FAR = 4.0
_ADVICE = (
    "check the convention of the poses, that they are in the order of the photos, and the "
    "intrinsics (docs/photos.md), or make poses by `qgs poses`"
)

Features = tuple[np.ndarray, np.ndarray]
"""Features of one photo: points (P, 2), x and y in pixels, and SIFT descriptors (P, 128)."""
Pairs = dict[tuple[int, int], float]
"""Pairs of frames, each with the median distance of matched points from the epipolar lines
that the poses predict, as a fraction of the photo's diagonal."""


@dataclass(frozen=True)
class Geometry:
    """Measurement of how well the poses of a scene fit its photos.

    unjudged: why nothing could be measured; empty if there are `pairs`. pairs: distances of matches
    from epipolar lines, see `Pairs`. diagonal: length of a photo's diagonal in pixels of the file.
    """

    unjudged: str = ""
    pairs: Pairs = field(default_factory=Pairs)
    diagonal: float = 0.0

    @property
    def fraction(self) -> float:
        """Median distance of matches from epipolar lines, as a fraction of the photo's diagonal.

        The median is over all pairs of photos; there must be some.
        """
        return float(np.median([*self.pairs.values()]))

    @property
    def pixels(self) -> float:
        """Median distance of matches from epipolar lines, in pixels of the stored photos."""
        return self.fraction * self.diagonal


def detect(picture: np.ndarray) -> Features:
    """Find SIFT features of a photo (H, W, 3), uint8; empty arrays if it shows no structure."""
    # kornia's SIFT finds as much, and takes one and a half times as long or more
    sift: Any = SIFT()
    try:
        # on grey, as SIFT is defined
        sift.detect_and_extract((picture @ _RGB_TO_GREY).astype(np.float32))
    except RuntimeError:
        # an image without any feature, such as a plain wall
        return np.zeros((0, 2)), np.zeros((0, 128))
    return sift.keypoints[:, ::-1] + 0.5, sift.descriptors


def match(first: Features, second: Features) -> np.ndarray | None:
    """Match the features of two photos; return P pairs of points, (2, P, 2) in pixels.

    Poses are not used. RANSAC keeps matches that fit one fundamental matrix. Returns None if fewer
    than MIN_MATCHES remain.
    """
    one, two = (torch.from_numpy(descriptors).float() for _, descriptors in (first, second))
    _, found = match_smnn(one, two, _RATIO)
    if len(found) < MIN_MATCHES:
        return None
    rows = found.numpy().T
    points = np.stack([first[0][rows[0]], second[0][rows[1]]])
    ransac = RANSAC("fundamental", inl_th=_INLIER_PIXELS, seed=0)
    _, inliers = ransac(*torch.from_numpy(points))
    return points[:, inliers.numpy()] if inliers.sum() >= MIN_MATCHES else None


def off_lines(matches: np.ndarray, poses: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return distances (P,) in pixels of points in the second photo from their epipolar half-lines.

    A half-line is the part of an epipolar line whose scene points lie before both cameras.
    matches: (2, P, 2), in pixels. poses: (2, 4, 4), camera-to-world, OpenCV axes. intrinsics:
    (2, 4), fx, fy, cx, cy.
    """
    # kornia has whole lines; two poses that are exchanged, or inverted ones, leave those as they
    # are where no camera turns
    points, seen = matches
    lens, own = intrinsics
    relative = np.linalg.inv(poses[1]) @ poses[0]
    rays = np.c_[(points - lens[2:]) / lens[:2], np.ones(len(points))]
    far = rays @ relative[:3, :3].T
    near = relative[:3, 3]
    infinity = far[:, :2] / far[:, 2:]
    toward = (near[:2] - near[2] * infinity) / far[:, 2:] * own[:2]
    length = np.linalg.norm(toward, axis=1, keepdims=True)
    # 0 without a baseline
    directions = toward / np.where(length > 0, length, 1)
    off = seen - (infinity * own[:2] + own[2:])
    across = off[:, 0] * directions[:, 1] - off[:, 1] * directions[:, 0]
    along = (off * directions).sum(1)
    # of points behind the first camera all of the line counts
    before = np.where(far[:, 2] > 0, np.minimum(along, 0), 0)
    return np.hypot(across, before)


def judge_scene(scene: DecodedScene, usable: Sequence[int], most: int) -> Geometry:
    """Measure how well the poses of a scene fit its photos.

    Each frame is matched with the next frame, and with a frame taken from another position. usable:
    frames that may be matched. most: largest number of frames to match; if more are usable, only
    some runs of consecutive frames are matched.
    """
    if len(usable) < 2:
        return Geometry("fewer than 2 usable frames")
    frames = _in_runs(usable, most)
    poses = np.stack([scene.photos[frame].listed.c2w for frame in frames])
    # no baseline, no epipolar lines
    if not np.ptp(poses[:, :3, 3], axis=0).any():
        return Geometry("all cameras on one point")
    features = []
    for frame in frames:
        picture, lens = scene.photos[frame].picture(scene.decoded[frame].size, SIDE)
        features.append((detect(picture), lens, float(np.hypot(*picture.shape[:2]))))

    @cache
    def distance(first: int, second: int) -> float | None:
        one, lens_of_one, diagonal = features[first]
        two, lens_of_two, _ = features[second]
        matches = match(one, two)
        if matches is None:
            return None
        both = poses[[first, second]]
        lenses = np.stack([lens_of_one, lens_of_two])
        there = off_lines(matches, both, lenses)
        back = off_lines(matches[::-1], both[::-1], lenses[::-1])
        # a fraction of the diagonal
        return float(np.median(there + back) / 2 / diagonal)

    pairs = Pairs()
    for start in range(len(frames)):
        # the next shares most and says least; a farther one has a baseline
        partners = list(_partners(poses[:, :3, 3], start))
        for group in ({start + 1}.intersection(partners), partners):
            for place in group:
                one, two = sorted((start, place))
                if (apart := distance(one, two)) is not None:
                    pairs[frames[one], frames[two]] = apart
                    break
    if not pairs:
        return Geometry(TOO_FEW)
    first, _ = next(iter(pairs))
    size = scene.decoded[first].size
    assert size is not None
    return Geometry(pairs=pairs, diagonal=float(np.hypot(*size)))


def _in_runs(frames: Sequence[int], most: int) -> Sequence[int]:
    """Return `frames`, or those of a few evenly spread slices if there are more than `most`."""
    if len(frames) <= most:
        return frames
    length = max(most // _RUNS, 2)
    starts = np.linspace(0, len(frames) - length, most // length).astype(int)
    return [frame for start in starts for frame in frames[start : start + length]]


def _partners(centres: np.ndarray, start: int) -> Iterator[int]:
    """Yield places that may show what `start` shows: near in the list, then near in space."""
    along = [start + gap for gap in _GAPS if 0 <= start + gap < len(centres)]
    forward = [place for place in along if place > start] or along
    distances = np.linalg.norm(centres - centres[start], axis=1)
    near = np.argsort(distances)[1:4].tolist()
    least = _NO_BASELINE * np.ptp(centres, axis=0).max()
    for place in dict.fromkeys([*forward, *near]):
        if distances[place] > least:
            yield place


def geometry_findings(scene: DecodedScene, geometry: Geometry) -> Iterator[Finding]:
    """Yield findings for poses that do not fit the photos, or a warning if nothing was measured."""
    if geometry.unjudged:
        reason = f"the poses are not checked against the photos: {geometry.unjudged}"
        yield Finding(scene.name, reason, "look at the cameras yourself", severity="warning")
        return
    # what moves lies off its lines, however good the poses are
    moves = len({photo.listed.time for photo in scene.photos}) > 1

    def severity(fraction: float) -> Severity:
        return "error" if fraction > _NONSENSE and not moves else "warning"

    better = float(np.quantile([*geometry.pairs.values()], 0.25))
    off = frames_above(geometry.pairs, max(min(_FAR * better, _NONSENSE), TOLERANCE))
    pairs = geometry.pairs.items()
    rest = [distance for frames, distance in pairs if off.keys().isdisjoint(frames)]
    # a few wrong frames are in most of the pairs of a short scene: without them it must agree
    if off and rest and np.median(rest) <= TOLERANCE:
        reason = "the pose or the intrinsics do not fit those of the other frames"
        fix = "check that both belong to the photo, correct them, or remove the frame"
        yield scene.finding(sorted(off), reason, fix, severity(min(off.values())))
    elif geometry.fraction > TOLERANCE:
        reason = (
            f"the poses do not fit the photos: matches lie {geometry.pixels:.1f} pixels from their "
            f"epipolar lines, median of {counted(len(geometry.pairs), 'pair')}; for good poses it "
            f"is at most {TOLERANCE * geometry.diagonal:.1f}"
        )
        every = range(len(scene.photos))
        advice = _ADVICE
        height, width = scene.decoded[0].size or (0, 1)
        # of other shapes both readings are understood
        if height == width and any(photo.listed.turns for photo in scene.photos):
            advice = f"these photos are square and turned by EXIF: {TURN}"
        yield scene.finding(every, reason, advice, severity(geometry.fraction))


def frames_above(values: Pairs, limit: float) -> dict[int, float]:
    """Return frames whose pairs all have values above `limit`, each with the least such value.

    Frames in fewer than two pairs are left out. The worst frame is found first and its pairs are
    removed, so that they do not count against the frames paired with the worst one.
    """
    found = dict[int, float]()
    while True:
        of_frame = defaultdict[int, list[float]](list)
        for frames, value in values.items():
            for frame in frames:
                of_frame[frame].append(value)
        above = {f: v for f, v in of_frame.items() if len(v) > 1 and min(v) > limit}
        if not above:
            return found
        worst = max(above, key=lambda frame: (len(above[frame]), sum(above[frame])))
        found[worst] = min(above[worst])
        values = {frames: value for frames, value in values.items() if worst not in frames}

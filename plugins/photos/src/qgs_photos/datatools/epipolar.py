"""Points that two photos share, and how far they are from where two poses want them."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from kornia.feature import match_smnn
from kornia.geometry.ransac import RANSAC
from skimage.feature import SIFT

# Fewer say nothing about a pair of photos.
MIN_MATCHES = 24
# Of descriptor distances (Lowe 2004).
_RATIO = 0.8
_INLIER_PIXELS = 1.5
_RGB_TO_GREY = np.array([0.299, 0.587, 0.114]) / 255


@dataclass(frozen=True)
class Features:
    """SIFT features of one photo, as rows.

    points: (P, 2) x, y in pixels. descriptors: (P, 128). colors: (P, 3) RGB in [0, 1].
    """

    points: np.ndarray
    descriptors: np.ndarray
    colors: np.ndarray


def detect(picture: np.ndarray) -> Features:
    """Find features of a photo (H, W, 3) uint8."""
    # kornia's SIFT finds as much, and takes one and a half times as long or more
    sift: Any = SIFT()
    try:
        # on grey, as SIFT is defined
        sift.detect_and_extract((picture @ _RGB_TO_GREY).astype(np.float32))
    except RuntimeError:
        # an image without any feature, such as a plain wall
        return Features(np.zeros((0, 2)), np.zeros((0, 128)), np.zeros((0, 3)))
    rows, columns = sift.keypoints.astype(int).T
    return Features(
        points=sift.keypoints[:, ::-1] + 0.5,
        descriptors=sift.descriptors,
        colors=picture[rows, columns] / 255,
    )


def match(first: Features, second: Features) -> np.ndarray | None:
    """Return pairs (P, 2) of features of one epipolar geometry, found without any pose.

    None for too few.
    """
    one, two = (torch.from_numpy(each.descriptors).float() for each in (first, second))
    _, pairs = match_smnn(one, two, _RATIO)
    if len(pairs) < MIN_MATCHES:
        return None
    points = [
        torch.from_numpy(f.points[rows]) for f, rows in zip((first, second), pairs.T, strict=True)
    ]
    _, inliers = RANSAC("fundamental", inl_th=_INLIER_PIXELS, seed=0)(points[0], points[1])
    return pairs[inliers].numpy() if inliers.sum() >= MIN_MATCHES else None


@dataclass(frozen=True)
class HalfLines:
    """Where P points of one photo may be seen in another: the parts of epipolar lines before both.

    ends: (P, 2), where points infinitely far away are seen, pixels. directions: (P, 2), unit, in
    which nearer ones lie; 0 without a baseline. ahead: (P,), False where all of the line counts.
    """

    ends: np.ndarray
    directions: np.ndarray
    ahead: np.ndarray

    def along(self, points: np.ndarray) -> np.ndarray:
        """Return how far `points` (P, 2) are along their lines, from the end on."""
        return ((points - self.ends) * self.directions).sum(1)

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Return the distances (P,) of `points` (P, 2), each from its half-line, in pixels."""
        off = points - self.ends
        across = off[:, 0] * self.directions[:, 1] - off[:, 1] * self.directions[:, 0]
        before = np.where(self.ahead, np.minimum(self.along(points), 0), 0)
        return np.hypot(across, before)


@dataclass(frozen=True)
class Pair:
    """Two frames and the P points they share; pixels (x, y), sizes (H, W).

    matches: (2, P, 2). colors: (2, P, 3) RGB in [0, 1]. poses: (2, 4, 4) camera-to-world, OpenCV.
    intrinsics: (2, 4) fx, fy, cx, cy.
    """

    frames: tuple[int, int]
    matches: np.ndarray
    colors: np.ndarray
    poses: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]

    def half_lines(self, photo: int) -> HalfLines:
        """Return where the other photo's points may be seen in `photo`, 0 or 1."""
        # kornia has whole lines; two poses that are exchanged, or inverted ones, leave those as
        # they are where no camera turns
        points = self.matches[1 - photo]
        lens = self.intrinsics[1 - photo]
        own = self.intrinsics[photo]
        relative = np.linalg.inv(self.poses[photo]) @ self.poses[1 - photo]
        rays = np.concatenate([(points - lens[2:]) / lens[:2], np.ones((len(points), 1))], 1)
        far = rays @ relative[:3, :3].T
        near = relative[:3, 3]
        infinity = far[:, :2] / far[:, 2:]
        toward = (near[:2] - near[2] * infinity) / far[:, 2:] * own[:2]
        length = np.linalg.norm(toward, axis=1, keepdims=True)
        return HalfLines(
            ends=infinity * own[:2] + own[2:],
            directions=toward / np.where(length > 0, length, 1),
            ahead=far[:, 2] > 0,
        )

    @cached_property
    def distance(self) -> float:
        """Median distance of matches to where the other photo's may be seen, of the diagonal."""
        both = [self.half_lines(photo).distances(self.matches[photo]) for photo in (0, 1)]
        return float(np.median(sum(both)) / 2 / np.hypot(*self.size))

    @property
    def channels_differ(self) -> bool:
        """Whether red and blue of one photo are exchanged against the other's."""
        # exposure moves all channels together, so their difference is compared
        one, two = self.colors[..., 0] - self.colors[..., 2]
        same = np.median(np.abs(one - two))
        exchanged = np.median(np.abs(one + two))
        # grey points differ by noise alone
        return bool(same > max(1.5 * exchanged, 0.02))


def frames_above(values: Sequence[tuple[tuple[int, int], float]], limit: float) -> dict[int, float]:
    """Return frames of two pairs or more whose values are all above `limit`, and the least of each.

    The worst goes first with its pairs, so that its partners are not blamed.
    """
    found = dict[int, float]()
    while True:
        of_frame = defaultdict[int, list[float]](list)
        for frames, value in values:
            for frame in frames:
                of_frame[frame].append(value)
        above = {f: v for f, v in of_frame.items() if len(v) > 1 and min(v) > limit}
        if not above:
            return found
        worst = max(above, key=lambda frame: (len(above[frame]), sum(above[frame])))
        found[worst] = min(above[worst])
        values = [item for item in values if worst not in item[0]]

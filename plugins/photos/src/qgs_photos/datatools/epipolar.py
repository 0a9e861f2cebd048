"""Points that two photos share, and how far they are from the epipolar lines of two poses."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from skimage.feature import SIFT, match_descriptors
from skimage.measure import ransac
from skimage.transform import FundamentalMatrixTransform

Reading: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""What a pose (4, 4) that was read may have been meant as."""

MIN_MATCHES = 24  # fewer say nothing about a pair of photos
_RATIO = 0.8  # of descriptor distances (Lowe 2004)
_INLIER_PIXELS = 1.5
_TRIALS = 400
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
    """Features of a photo (H, W, 3) uint8."""
    sift: Any = SIFT()
    try:
        sift.detect_and_extract((picture @ _RGB_TO_GREY).astype(np.float32))
    except RuntimeError:  # an image without any feature, such as a plain wall
        return Features(np.zeros((0, 2)), np.zeros((0, 128)), np.zeros((0, 3)))
    rows, columns = sift.keypoints.astype(int).T
    colors = picture[rows, columns] / 255
    return Features(sift.keypoints[:, ::-1] + 0.5, sift.descriptors, colors)


def match(first: Features, second: Features, seed: int = 0) -> tuple[np.ndarray, np.ndarray] | None:
    """Points (2, P, 2) of one epipolar geometry, found without any pose, and colours (2, P, 3).

    None for too few.
    """
    if min(len(first.points), len(second.points)) < MIN_MATCHES:
        return None
    pairs = match_descriptors(
        first.descriptors, second.descriptors, max_ratio=_RATIO, cross_check=True
    )
    if len(pairs) < MIN_MATCHES:
        return None
    a, b = first.points[pairs[:, 0]], second.points[pairs[:, 1]]
    found: Any = ransac(
        (a, b),
        FundamentalMatrixTransform,
        min_samples=8,
        residual_threshold=_INLIER_PIXELS,
        max_trials=_TRIALS,
        rng=seed,
    )
    inliers = found[1]
    if inliers is None or inliers.sum() < MIN_MATCHES:
        return None
    kept = pairs[inliers].T
    return np.stack([a[inliers], b[inliers]]), np.stack(
        [features.colors[rows] for features, rows in zip((first, second), kept, strict=True)]
    )


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

    @property
    def baseline(self) -> float:
        """Distance of the two cameras, scene units."""
        return float(np.linalg.norm(self.poses[1, :3, 3] - self.poses[0, :3, 3]))

    def lines(self, reading: Reading = np.asarray) -> np.ndarray:
        """Epipolar lines (2, P, 3), a x + b y + c = 0 (Hartley and Zisserman, section 9.2)."""
        first, second = (reading(pose) for pose in self.poses)
        relative = np.linalg.inv(second) @ first
        x, y, z = relative[:3, 3]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        one, two = (
            np.linalg.inv([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
            for fx, fy, cx, cy in self.intrinsics
        )
        fundamental = two.T @ cross @ relative[:3, :3] @ one
        a, b = _homogeneous(self.matches)
        return np.stack([b @ fundamental, a @ fundamental.T])

    def distance(self, reading: Reading = np.asarray) -> float:
        """Median distance of matches to where the other photo's may be seen, of the diagonal.

        That is the part of the epipolar line on which points are before both cameras: two poses
        that are exchanged leave the line as it is where neither turns. 0 without a baseline.
        """
        first, second = (reading(pose) for pose in self.poses)
        relative = np.linalg.inv(second) @ first
        one, two = self.matches
        there = _distances(one, two, relative, *self.intrinsics)
        back = _distances(two, one, np.linalg.inv(relative), *self.intrinsics[::-1])
        return float(np.median(there + back) / 2 / np.hypot(*self.size))


def _distances(
    from_: np.ndarray, to: np.ndarray, relative: np.ndarray, one: np.ndarray, two: np.ndarray
) -> np.ndarray:
    """Of points `to` (P, 2) from the half-lines on which those of the other photo may be seen.

    relative: (4, 4), first camera to second. one, two: (4,) intrinsics.
    """
    rays = np.concatenate([(from_ - one[2:]) / one[:2], np.ones((len(from_), 1))], 1)
    far, near = rays @ relative[:3, :3].T, relative[:3, 3]  # directions, and what is added nearby
    infinity = far[:, :2] / far[:, 2:]
    toward = (near[:2] - near[2] * infinity) / far[:, 2:] * two[:2]
    length = np.linalg.norm(toward, axis=1, keepdims=True)
    x, y = (toward / np.where(length > 0, length, 1)).T
    off = to - (infinity * two[:2] + two[2:])
    across = off[:, 0] * y - off[:, 1] * x
    along = np.where(far[:, 2] > 0, off[:, 0] * x + off[:, 1] * y, 0)
    return np.hypot(across, np.minimum(along, 0))


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1)

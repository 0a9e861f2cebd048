"""Points that two photos share, and how far they are from the epipolar lines of two poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from skimage.feature import SIFT, match_descriptors
from skimage.measure import ransac
from skimage.transform import FundamentalMatrixTransform

from qgs_datatools.conventions import Reading

MIN_MATCHES = 24
"""Fewer matches than this say nothing about a pair of photos."""

_RATIO = 0.8  # of descriptor distances (Lowe 2004)
_INLIER_PIXELS = 1.5
_TRIALS = 400


@dataclass(frozen=True)
class Features:
    """SIFT features of one photo. points: (P, 2) x, y in pixels. descriptors: (P, 128)."""

    points: np.ndarray
    descriptors: np.ndarray


@dataclass(frozen=True)
class Matches:
    """The same P scene points in two photos. first, second: (P, 2) x, y in pixels."""

    first: np.ndarray
    second: np.ndarray

    def __len__(self) -> int:
        return len(self.first)


def detect(grey: np.ndarray) -> Features:
    """Features of an image (H, W) in [0, 1]."""
    sift: Any = SIFT()
    try:
        sift.detect_and_extract(grey)
    except RuntimeError:  # an image without any feature, such as a plain wall
        return Features(np.zeros((0, 2)), np.zeros((0, 128)))
    return Features(sift.keypoints[:, ::-1] + 0.5, sift.descriptors)


def match(first: Features, second: Features, seed: int = 0) -> Matches | None:
    """Mutual matches that agree with one epipolar geometry, found from the photos alone.

    Poses play no part, so that wrong ones cannot hide behind the matches that they reject. None
    when fewer than MIN_MATCHES remain.
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
    return Matches(a[inliers], b[inliers])


@dataclass(frozen=True)
class Pair:
    """Two frames and what they share.

    poses: (2, 4, 4) camera-to-world, OpenCV axes as read. intrinsics: (2, 4) fx, fy, cx, cy.
    size: (H, W) of both photos, pixels.
    """

    frames: tuple[int, int]
    matches: Matches
    poses: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]

    def distance(self, reading: Reading = np.asarray) -> float:
        """Median epipolar distance, as a fraction of the diagonal, if poses are meant so."""
        first, second = (reading(pose) for pose in self.poses)
        distances = epipolar_distances(self.matches, first, second, self.intrinsics)
        return float(np.median(distances) / np.hypot(*self.size))


def epipolar_distances(
    matches: Matches, first: np.ndarray, second: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """Distance in pixels of each point (P,) to the epipolar line of its partner, both ways' mean.

    Arguments as of `epipolar_lines`. Two cameras on one point have no epipolar lines: all distances
    are then 0.
    """
    back, forth = epipolar_lines(matches, first, second, intrinsics)
    return (_line_distance(matches.second, forth) + _line_distance(matches.first, back)) / 2


def epipolar_lines(
    matches: Matches, first: np.ndarray, second: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The lines (P, 3) of points in the first photo and in the second on which matches must lie.

    A line is a, b, c of a x + b y + c = 0, in pixels; each is that of the point in the other photo.
    first, second: (4, 4) camera-to-world, OpenCV axes. intrinsics: (2, 4). The fundamental matrix
    is that of Hartley and Zisserman (2004), section 9.2.
    """
    relative = np.linalg.inv(second) @ first
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverse = [
        np.linalg.inv([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]) for fx, fy, cx, cy in intrinsics
    ]
    fundamental = inverse[1].T @ cross @ relative[:3, :3] @ inverse[0]
    a, b = _homogeneous(matches.first), _homogeneous(matches.second)
    return b @ fundamental, a @ fundamental.T


def _line_distance(points: np.ndarray, lines: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(lines[:, :2], axis=1)
    return np.abs((_homogeneous(points) * lines).sum(1)) / np.where(length > 0, length, 1.0)


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.ones((len(points), 1))], 1)

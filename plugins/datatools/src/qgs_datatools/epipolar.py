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


@dataclass(frozen=True)
class Features:
    """SIFT features of one photo. points: (P, 2) x, y in pixels. descriptors: (P, 128)."""

    points: np.ndarray
    descriptors: np.ndarray


def detect(grey: np.ndarray) -> Features:
    """Features of an image (H, W) in [0, 1]."""
    sift: Any = SIFT()
    try:
        sift.detect_and_extract(grey)
    except RuntimeError:  # an image without any feature, such as a plain wall
        return Features(np.zeros((0, 2)), np.zeros((0, 128)))
    return Features(sift.keypoints[:, ::-1] + 0.5, sift.descriptors)


def match(first: Features, second: Features, seed: int = 0) -> np.ndarray | None:
    """Points (2, P, 2) of one epipolar geometry, found without any pose; None for too few."""
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
    return np.stack([a[inliers], b[inliers]])


@dataclass(frozen=True)
class Pair:
    """Two frames and the P points they share; pixels (x, y), sizes (H, W).

    matches: (2, P, 2). poses: (2, 4, 4) camera-to-world, OpenCV. intrinsics: (2, 4) fx, fy, cx, cy.
    """

    frames: tuple[int, int]
    matches: np.ndarray
    poses: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]

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
        """Median distance of matches to their lines, of the diagonal; 0 without a baseline."""
        lines = self.lines(reading)
        length = np.linalg.norm(lines[..., :2], axis=-1)
        off = np.abs((_homogeneous(self.matches) * lines).sum(-1))
        distances = (off / np.where(length > 0, length, 1.0)).mean(0)
        return float(np.median(distances) / np.hypot(*self.size))


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1)
